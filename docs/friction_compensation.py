"""Compensate for dry friction with a model that cartlab found, and try it on a bench.

Usage: `python friction_compensation.py team-07/gap/model.fmu socket://127.0.0.1:40123`.

A PD controller moves cart 1 by 1 cm, but the spring and dry friction keep the cart off the target.
The linear model corrects the set point for the spring. The model with friction corrects it for
both.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import serial
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

TARGET = 441  # encoder counts, 1 cm
KP, KD = 0.2, 0.02  # duty counts per encoder count, and per encoder count per second
MOST = 4096  # duty counts
PERIOD, SECONDS = 0.001, 2.0
VOLT, CM = 0.0001220703125, 0.00227  # V per duty count, cm per encoder count, as the bench says


class Cart:
    """The model of one cart under the controller of the bench (docs/protocol.md)."""

    def __init__(self, fmu: Path, folder: str) -> None:
        """Load the FMU and unpack it into a folder."""
        description = read_model_description(str(fmu))
        self._refer = {v.name: v.valueReference for v in description.modelVariables}
        self._fmu = FMU2Slave(
            guid=description.guid,
            unzipDirectory=extract(str(fmu), folder),
            modelIdentifier="model",
            instanceName="cart",
        )
        self._fmu.instantiate()

    def rest(self, set_point: int, *, friction: bool) -> float:
        """Return the position at which the cart rests, in counts."""
        fmu, refer = self._fmu, self._refer
        fmu.reset()
        fmu.setupExperiment()
        fmu.enterInitializationMode()
        if not friction:
            fmu.setReal([refer["coulomb_friction_1_force"]], [0.0])
        fmu.exitInitializationMode()
        x, error = 0.0, 0
        for k in range(round(SECONDS / PERIOD)):
            before, error = error, set_point - round(x / CM)
            duty = KP * error + KD * (error - before) / PERIOD
            fmu.setReal([refer["u"]], [VOLT * min(max(duty, -MOST), MOST)])
            fmu.doStep(k * PERIOD, PERIOD)
            (x,) = fmu.getReal([refer["x1"]])
        return x / CM


def solve(rests_at: Callable[[int], float]) -> int:
    """Return the set point at which the cart rests on the target, by bisection."""
    low, high = TARGET, 10 * TARGET
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if rests_at(middle) < TARGET else (low, middle)
    return high


def try_on_bench(line: serial.SerialBase, set_point: int) -> int:
    """Return the position at which the cart rests on the bench, in counts."""
    step = f"d;q;c;o;{0.5 / SECONDS};{set_point};1;"  # zero for SECONDS, then the set point
    line.write(f"h;0;0;z;g;{KP};0;{KD};{step}".encode())
    x, milliseconds = read_line(line)
    while milliseconds > 0:  # a line of an earlier run
        x, milliseconds = read_line(line)
    while milliseconds < 2000 * SECONDS - 2:
        x, milliseconds = read_line(line)
    return x


def read_line(line: serial.SerialBase) -> tuple[int, int]:
    """Return the count of cart 1 and the time in ms."""
    x, _, _, _, milliseconds = line.readline().split(b":")
    return int(x), int(milliseconds)


def main(fmu: Path, address: str) -> dict[str, int]:
    """Design both set points, try them on the bench, and return the errors in counts."""
    errors = {}
    with (
        serial.serial_for_url(address) as line,
        TemporaryDirectory(ignore_cleanup_errors=True) as folder,
    ):
        cart = Cart(fmu, folder)
        for name, friction in (("linear", False), ("with friction", True)):
            set_point = solve(partial(cart.rest, friction=friction))
            errors[name] = try_on_bench(line, set_point) - TARGET
            print(f"{name}: set point {set_point} counts, error {errors[name]:+d} counts")
    return errors


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
