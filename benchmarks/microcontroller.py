"""Exported C files here and on a simulated Cortex-M7: the largest error of an action, instructions per step, sizes.

Each controller drives an episode in Python. The C file then gets the same states in the same order. A step is observing and
acting, and estimating before, where a filter is in front. QEMU counts one instruction as one nanosecond, and the steps of the
episode are counted one by one, each as the mean of many repetitions. It needs gcc and Debian's gcc-arm-none-eabi,
libnewlib-arm-none-eabi and qemu-system-arm.
"""

import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro

from ballbot_gym import files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import PAPER, ROBOTS, Sensors, named_robot
from ballbot_gym.rollout import Controller, rollout
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.policy.export_c import LQR, export_c
from ballbot_train.policy.printed import C

_STRICT = ("-std=c99", "-O2", "-Wall", "-Werror", "-ffunction-sections", "-fdata-sections")
_ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard")
_LINKED = ("-nostartfiles", "--specs=rdimon.specs", "-Wl,--gc-sections")
_QEMU = ("qemu-system-arm", "-M", "mps2-an500", "-nographic", "-semihosting-config", "enable=on", "-icount", "shift=0")
_TICK = 40  # instructions: the board's clock has 25 MHz
_REPETITIONS = 400

_MAP = """
ENTRY(reset)
SECTIONS {
    . = 0; .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) } .ARM.exidx : { *(.ARM.exidx*) }
    . = 0x20000000; .data : { *(.data*) } .bss : { *(.bss*) *(COMMON) } end = .;
}
"""
"""Where the board's memories are."""

_MAIN = """
#define BALLBOT_HEADER
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <unistd.h>
#include "controller.c"

static const float constants[] = {%(constants)s}, actions[] = {%(actions)s};
static const float shown[] = {%(shown)s}; /* states, or what sensors show */
enum { STEPS = sizeof actions / sizeof *actions / BALLBOT_ACTIONS, SHOWN = sizeof shown / sizeof *shown / STEPS };

static void step(int k, float *action)
{
    float observation[BALLBOT_OBSERVATIONS];
    const float *state = shown + SHOWN * k;
#ifdef FILTERED
    static const float place[] = {%(place)s};
    static float estimate[BALLBOT_STATES];
    if (k)
        ballbot_estimate(state, actions + BALLBOT_ACTIONS * (k - 1), estimate);
    else
        ballbot_first_estimate(state, place, estimate);
    state = estimate;
#endif
    ballbot_observe(state, constants, k * BALLBOT_CONTROL_DT, observation);
    ballbot_act(observation, action);
}

int main(void)
{
    float worst = 0, action[BALLBOT_ACTIONS];
    ballbot_reset();
    for (int k = 0; k < STEPS; ++k) {
        step(k, action);
        for (int i = 0; i < BALLBOT_ACTIONS; ++i)
            worst = fmaxf(worst, fabsf(action[i] - actions[BALLBOT_ACTIONS * k + i]));
    }
    printf("%%.9g\\n", (double)worst);
#ifdef __arm__
    volatile uint32_t *const timer = (uint32_t *)0xE000E010;
    timer[1] = 0xFFFFFF;
    timer[0] = 5; /* on, at the processor's clock */
    for (int k = 1; k < STEPS; k += STEPS / 20) {
        const uint32_t before = timer[2];
        for (int i = 0; i < %(repetitions)d; ++i)
            step(k, action);
        printf("%%lu\\n", (unsigned long)((before - timer[2]) & 0xFFFFFF));
    }
#endif
    return 0;
}

#ifdef __arm__
void initialise_monitor_handles(void);

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xF << 20; /* the floating-point unit */
    initialise_monitor_handles();
    main();
    fflush(stdout);
    _exit(0);
}

__attribute__((section(".vectors"), used)) static void *const vectors[] = {(void *)0x20400000, (void *)reset};
#endif
"""


@dataclass(frozen=True)
class Row:
    """One controller. Errors are of actions in [-1, 1]; sizes are of the compiled controller without libm, bytes."""

    task: str
    robot: str
    controller: str
    source_bytes: int
    flash_bytes: int
    ram_bytes: int
    error_here: float
    error_arm: float
    fewest_instructions: float
    most_instructions: float


def main(
    controllers: tuple[str, ...] = (
        "stabilize-lqr",
        "orbit-ppo",
        "orbit-sac",
        "orbit-apg-late",
        "stabilize-apg",
        "turn-ppo",
        "weave-dagger",
        "stabilize-omni-lqr-ekf",
        "stabilize-omni_strong-apg-ekf",
    ),
    out: Path = Path("runs/microcontroller"),
) -> None:
    """Writes OUT/microcontroller.csv.

    Args:
        controllers: TASK-NAME or TASK-ROBOT-NAME of lqr and of policies that come with the package; behind them -ekf.
        out: folder of the table, and of the code of each controller.
    """
    missing = [tool for tool in ("gcc", _ARM[0], _QEMU[0]) if shutil.which(tool) is None]
    if missing:
        sys.exit(
            f"{', '.join(missing)} not found. On Debian: "
            "apt-get install gcc gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
        )
    rows = []
    for each in controllers:
        task, _, name = each.partition("-")
        robot, _, rest = name.partition("-")
        robot, name = (robot, rest) if robot in ROBOTS else (PAPER, name)
        rows.append(_measured(task, robot, name, out / each))
        print(rows[-1])
    files.write_csv(out / "microcontroller.csv", [asdict(row) for row in rows])


def _measured(task: str, robot: str, name: str, folder: Path) -> Row:
    problem, controller = make_task(task, robot), ControllerName(name)
    filtered = bool(controller.filter)
    policy = LQR if controller.alone == LQR else ControllerName(controller.alone).path(problem, robot)
    source = export_c(policy, folder / "controller.c", problem, robot, filtered)
    main = _MAIN % {**_episode(task, robot, name, filtered), "repetitions": _REPETITIONS}
    files.write(folder / "main.c", filtered * "#define FILTERED\n" + main)
    files.write(folder / "board.ld", _MAP)

    def run(*command: str) -> list[str]:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()[-1000:]}")
        return done.stdout.split()

    run("gcc", *_STRICT, "main.c", "controller.c", "-o", "here", "-lm")
    run(*_ARM, *_STRICT, "-c", "controller.c", "-o", "controller.o")
    run(*_ARM, *_STRICT, "main.c", "controller.o", "-T", "board.ld", *_LINKED, "-o", "board.elf", "-lm")
    code, data, bss = (int(size) for size in run("arm-none-eabi-size", "controller.o")[6:9])
    error, *ticks = run(*_QEMU, "-kernel", "board.elf")
    instructions = [_TICK * int(tick) / _REPETITIONS for tick in ticks]
    return Row(
        task,
        robot,
        name,
        source.stat().st_size,
        code + data,
        data + bss,
        float(run("./here")[0]),
        float(error),
        min(instructions),
        max(instructions),
    )


class _Recorded:
    """A controller whose inputs, in float32, and forces are recorded."""

    def __init__(self, controller: Controller, filtered: bool):
        self._controller, self.senses = controller, filtered
        self.shown: list[np.ndarray] = []
        self.forces: list[np.ndarray] = []

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._controller.reset(t, self._single(x), c.astype(np.float32))

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        x = self._single(x)
        self.shown.append(x)
        self.forces.append(np.asarray(self._controller.act(t, x)))
        return self.forces[-1]

    def _single(self, x: np.ndarray) -> np.ndarray:
        """As the C file takes it: of sensors in SI units."""
        if not self.senses:
            return x.astype(np.float32)
        return np.append((x[:9] * Sensors.SCALE).astype(np.float32) / np.array(Sensors.SCALE), x[9:])


def _episode(task: str, robot: str, name: str, filtered: bool) -> dict[str, str]:
    """Constants of an episode, what the controller was shown in it, in float32, and Python's actions."""
    params = named_robot(robot)
    controller = _Recorded(ControllerName(name).make(make_task(task, robot), params), filtered)
    env = BallbotEnv(task, physics="rk4", robot=robot, observation="sensors" if filtered else "state")
    c = rollout(env, controller, seed=1).constants.astype(np.float32)
    shown, place = np.array(controller.shown), np.zeros(2)
    if filtered:
        shown, place = shown[:, :9] * Sensors.SCALE, shown[0, 9:11]
    actions = np.clip(np.array(controller.forces) / params.force_limit, -1, 1)
    arrays = {"constants": np.append(c, 0), "shown": shown, "place": place, "actions": actions}
    return {key: ", ".join(C.number(value) for value in array.ravel()) for key, array in arrays.items()}


if __name__ == "__main__":
    tyro.cli(main)
