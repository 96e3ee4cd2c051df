"""When a model follows a record, its derivatives equal differences of its errors."""

import numpy as np
import pytest

from pipeline.gap.pem import kernel as forces
from pipeline.gap.pem.model import (
    DRY,
    LawSet,
    PemSetup,
    RunParameters,
    TrialLaw,
    errors_of,
)
from pipeline.gap.runs import make_run
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.terms import EffectKind
from tests.truth.cases import make_case

# Sizes relative to the largest input, the largest position, cart 1's mass and spring 2.
SIZES = {
    EffectKind.COULOMB_FRICTION: lambda u, x, m, k: (0.02 * u,),
    EffectKind.LOAD_FRICTION: lambda u, x, m, k: (0.02,),
    EffectKind.QUADRATIC_DRAG: lambda u, x, m, k: (2e-5,),
    EffectKind.FORCE_OFFSET: lambda u, x, m, k: (0.02 * u,),
    EffectKind.CUBIC_SPRING: lambda u, x, m, k: (0.01 * k / x**2,),
    EffectKind.ASYMMETRIC_SPRING: lambda u, x, m, k: (0.01 * k / x,),
    EffectKind.SLACK_SPRING: lambda u, x, m, k: (0.3 * k, 0.4 * x),
    EffectKind.COUPLING_DAMPER: lambda u, x, m, k: (1e-4,),
    EffectKind.DRIVE_DAMPING: lambda u, x, m, k: (1e-4,),
    EffectKind.END_STOP: lambda u, x, m, k: (5.0 * k, 0.6 * x, 1e-3),
    EffectKind.STICTION: lambda u, x, m, k: (0.02 * u, 2.0 * x),
    EffectKind.PRESLIDING_FRICTION: lambda u, x, m, k: (0.02 * u, 0.02 * x),
    EffectKind.EXTRA_MODE: lambda u, x, m, k: (0.1 * m, 900.0, 2.0),
    EffectKind.COGGING: lambda u, x, m, k: (0.02 * u, 0.01 * u, 0.3 * x),
    EffectKind.SENSOR_GAIN: lambda u, x, m, k: (0.03,),
    EffectKind.BACKLASH: lambda u, x, m, k: (0.1 * x, 0.3 * m, 0.6),
}
DRIVEN = (EffectKind.DRIVE_DAMPING, EffectKind.COGGING, EffectKind.BACKLASH)
# The error jumps when the turning point of a cart or a contact moves past a reading.
JUMPS = (*DRY, EffectKind.BACKLASH)


@pytest.mark.parametrize("gain", [0.5, 0.1, 0.0])
@pytest.mark.parametrize("kind", SIZES)
def test_derivatives_agree_with_differences_of_the_errors(kind, gain):
    """Derivatives with respect to parameters and a run's start agree with finite differences."""
    case = make_case(seed=44, n=2, rate=113.1)
    chain = Chain(m=np.array(case.m), c=np.array(case.c), k=np.array(case.k))
    run = make_run(case.records[0], n=2)
    largest, top = float(np.abs(run.command).max()), float(np.abs(run.y).max())
    bench = PemSetup(chain=chain, springs=case.springs, largest=largest, free=((True, True),))
    values = SIZES[kind](largest, top, float(chain.m[0]), float(chain.k[1]))
    own = RunParameters.of(run)
    start = np.concatenate([own.zero, own.shift + 0.01 * top, own.v0 + 0.1, own.factor])

    for place in (0,) if kind in DRIVEN else (0, 1):
        bare = LawSet(bench=bench, keys=(), drive=(True,) * forces.DRIVE)
        law = TrialLaw(kind=kind, place=place, values=values)
        laws, p = bare.with_laws(bare.start(chain), [law])
        p[laws.drive_at : laws.base] = 0.05 * largest, 0.9 * largest, 0.006, 0.01

        def errors(both, *, derive=False, laws=laws):
            size = laws.size
            mine = RunParameters(**dict(zip(vars(own), both[size:].reshape(4, 2), strict=True)))
            told = errors_of(laws, both[:size], run, mine, gain=gain, derive=derive)
            assert told is not None
            return told

        at = np.concatenate([p, start])
        _, J = errors(at, derive=True)
        steps = np.diag(1e-5 * np.where(at == 0.0, 1e-3, np.abs(at)))
        present = at != 0.0
        present[p.size : p.size + 2] = True  # the zero of an encoder has an effect even if it is 0
        for lane in np.flatnonzero(present):
            above, below = (errors(at + sign * steps[lane])[0] for sign in (1.0, -1.0))
            numeric = (below - above) / (2.0 * steps[lane, lane])
            off = np.abs(numeric - J[lane]) / max(np.abs(J[lane]).max(), 1e-12)
            if kind in JUMPS:
                assert np.quantile(off, 0.9) < 0.02, lane
            else:
                assert off.max() < 1e-4, lane
