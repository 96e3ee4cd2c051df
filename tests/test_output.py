"""Results are written whole, in their place, and never through a link."""

import pytest

from pipeline.errors import ConfigError
from pipeline.output import check_folder, clear_files, new_folder, own_folder, write_file


def test_a_file_is_replaced_whole(tmp_path):
    """New content takes the place of the old, with nothing left beside it."""
    path = tmp_path / "results.json"
    write_file(path, "old")
    (tmp_path / ".results.json.part").write_text("left by a run that was stopped")
    write_file(path, "ω\n")
    assert path.read_bytes() == "ω\n".encode()
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


def test_a_link_is_replaced_not_followed(tmp_path):
    """A link that a submission brought does not lead our output to another file."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    link = tmp_path / "report.html"
    link.symlink_to(victim)
    write_file(link, "ours")
    assert victim.read_text() == "precious"
    assert (link.read_text(), link.is_symlink()) == ("ours", False)


def test_a_linked_folder_inside_a_submission_is_refused(tmp_path):
    """The default output folder of a submission must be a folder of its own."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "report").symlink_to(elsewhere)
    with pytest.raises(ConfigError, match="is a link; name another folder with --out"):
        own_folder(tmp_path, "report")
    assert check_folder(tmp_path / "report").is_dir()  # where the user says so himself


def test_a_file_in_the_way_is_refused(tmp_path):
    """A file where the output folder should be is named."""
    (tmp_path / "out").write_text("")
    with pytest.raises(ConfigError, match="out: is a file"):
        check_folder(tmp_path / "out")


def test_stale_files_go(tmp_path):
    """Only what matches is removed, links included, folders not."""
    (tmp_path / "a.svg").write_text("")
    (tmp_path / "keep.txt").write_text("")
    (tmp_path / "b.svg").mkdir()
    clear_files(tmp_path, "*.svg")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.svg", "keep.txt"]


def test_a_folder_with_something_in_it_is_not_new(tmp_path):
    """A submission is never written over another; an empty folder will do."""
    assert new_folder(tmp_path / "fresh") == tmp_path / "fresh"
    assert new_folder(tmp_path) == tmp_path
    (tmp_path / "submission.toml").write_text("")
    with pytest.raises(ConfigError, match="is not empty"):
        new_folder(tmp_path)
