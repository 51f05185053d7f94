# make demo   install into .venv and run the benchmark on an eighth of the episodes: LQR, trajectory optimization, NMPC
# make test   install into .venv, then lint and test
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-slow bench docs certify clean

demo: $(VENV)/installed
	$(BIN)/ballbot benchmark --episodes 25 --out runs/demo

test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pytest -m "not slow"

test-slow: $(VENV)/installed
	$(BIN)/pytest -m slow

bench: $(VENV)/installed
	$(BIN)/pip install -c constraints.txt -e ".[bench]"
	for script in benchmarks/*.py; do $(BIN)/python $$script; done

# the documentation as a site
docs: $(VENV)/installed
	$(BIN)/mkdocs build --strict

# the optima that the package ships, computed anew
certify: $(VENV)/installed
	$(BIN)/ballbot certify

$(VENV)/installed: pyproject.toml constraints.txt
	command -v $(PYTHON) >/dev/null || { echo "ballbot-gym needs Python 3.11 (PyBullet has no newer wheels): make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -c constraints.txt "torch==2.13.0"
	$(BIN)/pip install -c constraints.txt -e ".[all,dev,docs]"
	touch $@

clean:
	rm -rf $(VENV) runs build dist *.egg-info
