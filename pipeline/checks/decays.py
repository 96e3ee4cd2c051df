"""Say which law a free decay follows."""

from pipeline.results import DecayLaw, LogDecrement
from pipeline.words.numbers import significant, with_error
from pipeline.words.phrases import phrases

_WORDS = phrases("decays")


def say_law(decay: LogDecrement, *, unit: str) -> str:
    """Return the law with its numbers, as the end of a sentence about the decay."""
    law, said = decay.law, _numbers(decay, unit=unit)
    numbers = _WORDS.text("numbers", zeta=said["zeta"], omega_n=said["omega_n"])
    return _WORDS.text(_key(law), numbers=numbers, **said)


def name_law(decay: LogDecrement, *, unit: str) -> str:
    """Return the law in a few words, with the size of its cause."""
    law = decay.law
    said = _numbers(decay, unit=unit) | {"size": with_error(law.size, law.size_std)}
    return _WORDS.text(f"short_{_key(law)}", **said)


def _key(law: DecayLaw) -> str:
    return "untested" if law.is_untested else law.name


def _numbers(decay: LogDecrement, *, unit: str) -> dict[str, str]:
    law = decay.law
    return {
        "statistic": f"{law.statistic:.1f}",
        "limit": f"{law.limit:.1f}",
        "size": significant(law.size, digits=3),
        "percent": f"{100 * abs(law.size):.2g}",
        "side": "higher" if law.size > 0 else "lower",
        "zeta": significant(law.zeta, digits=3),
        "omega_n": significant(law.omega_n, digits=4),
        "apparent": significant(decay.zeta, digits=3),
        "unit": unit,
    }
