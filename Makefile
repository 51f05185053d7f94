# make demo   install into .venv and run the benchmark on a twentieth of the episodes: LQR, trajectory optimization, NMPC
# make test   install into .venv, then lint, check types and test
# make pythons  the same on other Pythons, without torch: tests of the environments and experts, and README's ten lines
# make clients  install other people's libraries into .venv-clients and run docs/clients.md with them
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
SCRIPTS := $(if $(filter Windows_NT,$(OS)),Scripts,bin)

# Where bytecode may not be written, as in some containers, every process that a test or a command starts compiles what it
# imports anew: one that trains takes 6 s to start in place of 2.5.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test types pytest test-slow verify bench bench-release soak faults fuzz docs notebooks pictures gallery certify clients pythons ray clean
.PHONY: platforms code dist cross release metadata

demo: $(VENV)/runs
	$(BIN)/ballbot benchmark --episodes 10 --out runs/demo

test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --jobs 2 types pytest

types: $(VENV)/installed
	$(BIN)/basedpyright --pythonpath $(BIN)/python

# A worker for each core; with one more, the tests would need a fifth more of the processor's time.
WORKERS ?= $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)

pytest: $(VENV)/installed
	$(BIN)/pytest -m "not slow" -n $(WORKERS) --dist worksteal

test-slow: $(VENV)/installed
	$(BIN)/pytest -m slow

# the submissions that lie beside rows of the leaderboard; with RECORDINGS=FOLDER also those of releases, downloaded there
verify: $(VENV)/installed
	BALLBOT_RECORDINGS=$(RECORDINGS) $(BIN)/pytest tests/test_submissions.py -k "beside or row"

# one page with all figures of speed, beside those of the last page of another commit
bench: $(VENV)/installed
	$(INSTALL) -e ".[bench]"
	$(BIN)/python benchmarks/page.py

# the same, and the figures go into the table of all releases, benchmarks/releases.csv
bench-release: $(VENV)/installed
	$(INSTALL) -e ".[bench]"
	$(BIN)/python benchmarks/page.py --release

# millions of steps and a thousand environments: time and memory must not grow
soak: $(VENV)/installed
	$(BIN)/python benchmarks/soak.py

# every long command is killed fifty times, and meets full disks, read-only folders, a second run and dead workers
faults: $(VENV)/installed
	$(BIN)/python benchmarks/faults.py

# every reader is given mutations of valid files, ten minutes each
fuzz: $(VENV)/installed
	$(BIN)/python benchmarks/fuzz.py

# the documentation as a site
docs: $(VENV)/installed
	$(BIN)/mkdocs build --strict

# the documentation's notebooks, run anew
notebooks: $(VENV)/installed
	$(BIN)/python docs/make_notebooks.py

# the pictures and films of the documentation that show other policies than the shipped ones, or were made by another command
pictures: $(VENV)/installed
	$(BIN)/python docs/make_pictures.py

# the films of the leaderboard's rows, and the pages that show them
gallery: $(VENV)/installed
	$(BIN)/python docs/make_gallery.py

# RLlib is tested where it is installed; it pins another Gymnasium, so that it cannot be here. RL Zoo wants an older dateutil,
# and torchrl an older tensordict; without this minimum pip takes a torchrl from before Gymnasium 1.
CLIENTS := torchrl>=0.14 skrl rl-zoo3 rsl-rl-lib

clients: $(VENV)/installed
	$(BIN)/python -m venv .venv-clients
	grep -v "^python-dateutil\|^tensordict" constraints.txt > .venv-clients/constraints.txt
	.venv-clients/bin/pip install -c .venv-clients/constraints.txt "torch==2.13.0"
	.venv-clients/bin/pip install -c .venv-clients/constraints.txt -e ".[all]" pytest $(patsubst %,"%",$(CLIENTS))
	.venv-clients/bin/python -m pytest -rs tests/test_clients.py

# Every Python in an environment of its own, in which uv finds or fetches it: first what `[mujoco]` brings, where no warning may
# appear, then experts and README's ten lines, and last whether all that `[train]` needs has wheels. One alone: make python-3.13
PYTHONS := 3.10 3.12 3.13 3.14
APPLY := $(addprefix tests/test_,env.py mujoco.py picture.py tasks.py dynamics.py step_code.py lqr.py optimum.py)

pythons: $(addprefix python-,$(PYTHONS))

.venv-pythons/uv/$(SCRIPTS)/uv:
	python3 -m venv .venv-pythons/uv
	.venv-pythons/uv/$(SCRIPTS)/pip install uv

python-%: .venv-pythons/uv/$(SCRIPTS)/uv
	.venv-pythons/uv/$(SCRIPTS)/uv venv --clear --seed --python $* .venv-pythons/$*
	.venv-pythons/$*/$(SCRIPTS)/pip install --no-compile -e ".[mujoco]" pytest
	.venv-pythons/$*/$(SCRIPTS)/python -m pytest tests/test_extras.py -k without_a_warning
	.venv-pythons/$*/$(SCRIPTS)/pip install --no-compile -e ".[mujoco,baselines]" filelock pytest rich tyro
	.venv-pythons/$*/$(SCRIPTS)/python -m pytest -m "not slow" -k "not spec_of_an_env and not vector and not display" $(APPLY)
	sed '1,/^```python/d; /^```/,$$d' README.md | .venv-pythons/$*/$(SCRIPTS)/python -
	.venv-pythons/$*/$(SCRIPTS)/pip install --dry-run --quiet --only-binary=:all: -e ".[train]"

# whether all that is needed has wheels on every system and Python; the registry is asked, and nothing is installed
platforms: .venv-pythons/uv/$(SCRIPTS)/uv
	python3 release/platforms.py .venv-pythons/uv/$(SCRIPTS)/uv

# the C code of all shipped robots and tasks
code: build/code/codes.json

build/code/codes.json: $(VENV)/installed $(shell find ballbot_gym baselines train -name "*.py" -o -name "*.[ch]")
	rm -f build/code/*.c build/code/source/*
	$(BIN)/python release/generated.py build/code

# what is published, in dist/: the source, a wheel for every machine, and one with compiled code for machines like this one. Each
# is installed in new environments outside of the repository, and used without a compiler and without a home.
dist: build/code/codes.json
	$(INSTALL) build twine
	$(BIN)/python release/wheels.py build/code dist
	$(BIN)/twine check --strict dist/*
	$(BIN)/python release/check_dist.py dist

# that code compiled for every system and processor, without a warning
cross: build/code/codes.json
	$(INSTALL) ziglang
	$(BIN)/python release/cross.py build/code

# what other sites list: Croissant, Zenodo and the scores of Minari's datasets
metadata: $(VENV)/installed
	$(BIN)/python release/metadata.py

# checks that this version can be published, builds it, and prints the notes of its tag
release: $(VENV)/installed
	$(BIN)/python release/version.py check
	$(MAKE) dist
	$(BIN)/python release/version.py notes

# Ray clusters of two nodes on this machine, with nodes that are killed
ray: $(VENV)/installed
	$(INSTALL) -e ".[ray]"
	$(BIN)/pytest tests/test_ray.py

# the optima that the package ships, computed anew
certify: $(VENV)/installed
	$(BIN)/ballbot certify

# PyBullet has no wheels for newer Pythons than 3.11. Where it is missing, uv fetches it. Python compiles what is imported, when
# it is first imported; pip would compile everything. Python 3.11 brings a pip that takes twice the time to resolve and install,
# and `venv` compiles that one first, so the new pip comes from the interpreter's own where that can install into other folders.
INSTALL := $(BIN)/pip install --no-compile -c constraints.txt

$(VENV)/python: pyproject.toml constraints.txt
	@if command -v $(PYTHON) >/dev/null; then \
		{ $(PYTHON) -m venv --without-pip $(VENV) && $(PYTHON) -m pip --python $(VENV) install --no-compile "pip>=25"; } || \
		{ $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip install --no-compile "pip>=25"; }; \
	elif command -v uv >/dev/null; then \
		uv venv --allow-existing --seed --python 3.11 $(VENV); \
	else \
		echo "ballbot-gym needs Python 3.11, and $(PYTHON) is not a command here."; \
		echo "Install Python 3.11 or uv, or name your interpreter: make PYTHON=/path/to/python3.11"; \
		exit 1; \
	fi
	touch $@

# what the commands need
$(VENV)/runs: $(VENV)/python
	$(INSTALL) -e ".[train]"
	touch $@

# what tests, types and documentation need
$(VENV)/installed: $(VENV)/python
	$(INSTALL) -e ".[all,dev,docs]"
	touch $@

clean:
	rm -rf $(VENV) .venv-clients .venv-pythons runs build dist *.egg-info
