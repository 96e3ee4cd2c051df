"""The list of faults is true, and a fault counts as noticed only by a test that fails."""

from collections import Counter

import pytest

from benchmarks import faults

_FAULT = faults.Fault(
    file="grading/tolerance.py", old="", new="", tests="grading", breaks="nothing"
)


def test_every_fault_is_one_fragment_of_its_file():
    listed = faults.read_faults()

    assert len(listed) == 100
    assert Counter((one.file, one.old) for one in listed).most_common(1)[0][1] == 1
    assert all((faults.CHECKOUT / "tests" / one.tests).is_dir() for one in listed)


def test_a_fragment_that_is_gone_is_refused(tmp_path, monkeypatch):
    entry = 'file = "lock.py"\nold = "no such line"\nnew = ""\ntests = "system"\nbreaks = ""\n'
    (tmp_path / "faults.toml").write_text(f"[[faults]]\n{entry}")
    monkeypatch.setattr(faults, "LIST", tmp_path / "faults.toml")

    with pytest.raises(ValueError, match="0 times"):
        faults.read_faults()


def test_the_tests_of_the_faulty_module_run_first():
    assert faults.order_files(_FAULT, faults.CHECKOUT)[0] == "tests/grading/test_tolerance.py"


@pytest.mark.parametrize(("claim", "test"), [("True", ""), ("False", "tests/test_it.py::test_it")])
def test_only_a_failing_test_notices(claim, test, tmp_path):
    (tmp_path / "benchmarks").symlink_to(faults.CHECKOUT / "benchmarks")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_it.py").write_text(f"def test_it():\n    assert {claim}\n")

    outcome = faults.run_tests(["tests/test_it.py"], tmp_path, most=60.0)

    assert outcome.test == test
