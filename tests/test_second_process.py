"""A second process gives the answer that the first one would give, and ends with it."""

import os
import pickle
import sys

import psutil
import pytest

from pipeline.errors import DataError
from pipeline.plant.catalogue import CATALOGUE
from pipeline.second_process import SecondProcess
from pipeline.words.progress import silent

HELPER = "tests.helpers.another_process"


@pytest.fixture(autouse=True)
def not_loaded(monkeypatch):
    """Forget the helper module, which an earlier test may have loaded here."""
    monkeypatch.delitem(sys.modules, HELPER, raising=False)


def test_another_process_does_the_work_and_reports_its_stages():
    """The function is called in another process, with all arguments, and its stages arrive."""
    stages = []
    with SecondProcess(HELPER, "where") as second:
        process, args, named = second.do(1, "b", progress=stages.append, c=[2.5])
    assert process != os.getpid()
    assert (args, named) == ((1, "b"), {"c": [2.5]})
    assert stages == ["one", "two"]
    assert HELPER not in sys.modules


def test_this_process_takes_over_when_the_second_one_dies():
    """If the second process dies during its work, this process does the work."""
    with SecondProcess(HELPER, "die_elsewhere") as second:
        assert second.do(os.getpid(), progress=silent) == os.getpid()


def test_this_process_takes_over_when_no_second_one_can_start(monkeypatch, tmp_path):
    """If no process can be started, this process does the work."""
    monkeypatch.setattr(sys, "executable", str(tmp_path / "missing"))
    with SecondProcess(HELPER, "where") as second:
        assert second.do(progress=silent)[0] == os.getpid()


def test_an_error_of_the_work_is_raised_here():
    """An error in the second process is raised in this one, as itself."""
    with (
        SecondProcess(HELPER, "refuse") as second,
        pytest.raises(DataError, match="no data"),
    ):
        second.do(progress=silent)


def test_an_interrupt_ends_the_second_process():
    """After Ctrl-C in this process, the second one has ended too."""
    started = []

    def interrupt(stage: str) -> None:
        started.append(int(stage))
        raise KeyboardInterrupt

    with (
        pytest.raises(KeyboardInterrupt),
        SecondProcess(HELPER, "linger") as second,
    ):
        second.do(progress=interrupt)
    assert not psutil.pid_exists(started[0])


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
def test_every_effect_can_be_sent_to_another_process(effect):
    """An effect is equal to itself after a journey to another process."""
    assert pickle.loads(pickle.dumps(effect)) == effect
