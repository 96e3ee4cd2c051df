"""For every effect, a size on `throne-2dof` that is clearly visible and safe to simulate."""

from collections.abc import Mapping

from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, Effect, EffectTerm, chain_scales

SIZES = {
    "coulomb_friction": {"force": 0.001},
    "stiction": {"force": 0.001, "static_force": 0.002, "velocity": 1.0},
    "presliding_friction": {"force": 0.001, "distance": 0.02},
    "load_friction": {"coefficient": 0.05},
    "quadratic_drag": {"coefficient": 3e-5},
    "force_offset": {"force": 0.004},
    "cubic_spring": {"coefficient": 0.02},
    "asymmetric_spring": {"coefficient": 0.008},
    "slack_spring": {"stiffness_change": 0.8, "stretch": 0.15},
    "coupling_damper": {"coefficient": 3e-4},
    "drive_damping": {"coefficient": 3e-4},
    "dead_zone": {"width": 0.005},
    "saturation": {"limit": 0.03},
    "input_delay": {"delay": 0.0123},
    "actuator_lag": {"time_constant": 0.015},
    "sensor_gain": {"gain": 1.05},
    "extra_mode": {"mass": 3e-5, "stiffness": 0.03, "damping": 5e-5},
    "end_stop": {"position": 0.8, "stiffness": 2.0},
    "backlash": {"gap": 0.05},
    "cogging": {"force": 0.003, "pitch": 0.3, "phase": 1.0},
}


def make_term(
    effect: Effect, *, place: int, values: Mapping[str, float], chain: Chain
) -> EffectTerm:
    """Return an effect with named values; details of its contacts have usual values by default."""
    scales = chain_scales(chain, place=effect.place, at=place)
    light = {"motor_mass": 0.1}
    details = [p for p in effect.parameters if not p.reported]
    usual = {p.name: light.get(p.name, p.typical) * p.size(scales) for p in details} | {**values}
    sizes = tuple(float(usual[name]) for name in effect.names)
    return EffectTerm(effect=effect, place=place, values=sizes)


def model_with(key: str, chain: Chain, *, place: int = 0, **values: float) -> AugmentedChain:
    """Return a chain with one effect."""
    term = make_term(find_effect(key), place=place, values=values, chain=chain)
    return AugmentedChain(chain=chain, terms=(term,))
