"""The line of links at the top of every page."""

from pipeline.desk.gradebooks import Gradebooks
from pipeline.desk.navigation import list_links
from pipeline.desk.users import User


def test_a_gradebook_that_cannot_be_reached_breaks_no_page(tmp_path, monkeypatch):
    """If a gradebook's network drive is gone, its link stays, without the number of requests."""
    books = Gradebooks()

    def gone(place):
        raise OSError("stale file handle")

    monkeypatch.setattr(books, "gradebook", gone)
    user = User(name="", role="owner", gradebooks=[tmp_path / "class"])
    assert [room.name for room in list_links(user, "/", books)] == ["Desk", "class"]
