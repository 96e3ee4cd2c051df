"""The one-cart lab with figures coded by hand, as notebook cells that run in a submission."""

# %%
import tomllib
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from lab_reference import final, initial, ratio, read  # pyright: ignore[reportMissingImports]

lab = tomllib.loads(Path("submission.toml").read_text(encoding="utf-8"))
dwells = {
    Path(one["file"]).name: one["frequency"] for one in lab["experiments"] if one["kind"] == "sine"
}
print(initial())

# %%
for kind in ("decay", "step"):
    files = sorted(Path("data").glob(f"{kind}-*.csv"))
    figure, axes = plt.subplots(1, len(files), figsize=(9, 2.5), sharey=True)
    for ax, file in zip(axes, files, strict=True):
        data = read(file)
        ax.plot(data["time"], data["x1"], ".", ms=1)
        ax.set(title=file.stem, xlabel="t [s]")
    axes[0].set_ylabel("x1 [cm]")
    plt.show()

# %%
files = list(dwells)[:: max(1, len(dwells) // 3)][:3]
figure, axes = plt.subplots(1, 3, figsize=(9, 2.5))
for ax, file in zip(axes, files, strict=True):
    data = read(Path("data") / file)
    ax.plot(data["time"], data["x1"], label="x1 [cm]")
    ax.plot(data["time"], data["input"], label="u [V]")
    ax.set(title=f"{dwells[file]:g} Hz", xlabel="t [s]")
axes[0].legend()
plt.show()

# %%
omega = 2 * np.pi * np.array([*dwells.values()])
measured = np.array([ratio(read(Path("data") / f), w) for f, w in zip(dwells, omega, strict=True)])
found = final(tuple(sorted(dwells.items())))
print(found)


def response(omega):
    r = omega / found["omega_n"]
    return found["K"] / (1 - r**2 + 2j * found["zeta"] * r)


dense = np.geomspace(omega.min(), omega.max(), 300)
figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True)
above.semilogx(omega, 20 * np.log10(measured), "D", label="measured")
above.semilogx(dense, 20 * np.log10(np.abs(response(dense))), label="fit")
above.set_ylabel("|X1/U| [dB]")
above.legend()
below.semilogx(omega, 100 * (measured / np.abs(response(omega)) - 1), "D")
below.set(xlabel="ω [rad/s]", ylabel="residual [%]")
plt.show()

# %%
data = read(Path("data") / "control.csv")
figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4), sharex=True)
above.plot(data["time"], data["x1"], label="measured")
above.plot(data["time"], data["reference"], "--", label="set point")
above.legend()
below.plot(data["time"], data["input"])
below.set(xlabel="t [s]", ylabel="u [V]")
plt.show()
