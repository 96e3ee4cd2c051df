"""A number too large or too small to compute with does not keep a student from the page."""

import pytest

from pipeline.desk.app import DeskServer
from pipeline.submission.load import NAME
from tests.helpers.desks import Visitor, a_submission

pytestmark = pytest.mark.usefixtures("all_work_here")
HERE = "/student/0/"


@pytest.mark.parametrize("number", ["1e1000000", "1e-99999999999999999999", "0x" + "f" * 5000])
def test_a_student_can_still_open_the_page(tmp_path, number):
    """The student's page opens and names the wrong number, even after another upload."""
    folder = a_submission(tmp_path / "team")
    text = (folder / NAME).read_text(encoding="utf-8")
    assert "\nK = 28.7\n" in text
    text = text.replace("\nK = 28.7\n", f"\nK = {number}\n", 1)
    (folder / NAME).write_text(text, encoding="utf-8")
    with DeskServer(folder=folder) as server:
        visitor = Visitor.of(server.url)
        page = visitor.get(HERE)
        assert page.status == 200
        assert "expected a number between 1e-30 and 1e+30 in size, or 0" in page.text
        sent = [(NAME, text.encode())]
        assert visitor.upload(f"{HERE}files", sent).status < 500
        assert visitor.get(HERE).status == 200
