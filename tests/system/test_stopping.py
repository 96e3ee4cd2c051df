"""Ctrl-C ends a command even if a library swallows the interrupt."""

import contextlib
import signal

import pytest

from pipeline.cli.common import ctrl_c_says


def _work(said: list[str], *, look: bool = False, error: Exception | None = None) -> None:
    """Press Ctrl-C during work that swallows it; then raise `error`, or check if `look` is set."""
    with ctrl_c_says(lambda: said.append("stopped")) as looked:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        if error:
            raise error
        if look:
            looked()
            said.append("went on")


@pytest.mark.parametrize("how", [{"look": True}, {"look": False}, {"error": ValueError("broken")}])
def test_an_interrupt_that_a_library_drops_ends_the_work(how):
    """If a library swallows Ctrl-C, the command still ends, at its next check or at its end.

    The exit status is 130 even if the interrupted library raises an error.
    """
    said = []
    with pytest.raises(SystemExit) as ended:
        _work(said, **how)
    assert ended.value.code == 130
    assert said == ["stopped"]


def test_an_error_without_ctrl_c_stays_an_error():
    """Only an error after Ctrl-C counts as an interrupt."""
    with pytest.raises(ValueError, match="broken"), ctrl_c_says(lambda: None):
        raise ValueError("broken")


def test_the_earlier_ctrl_c_handler_is_restored():
    """After the command's work the earlier handler of Ctrl-C is restored."""
    before = signal.getsignal(signal.SIGINT)
    with ctrl_c_says(lambda: None):
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before
