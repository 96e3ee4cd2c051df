"""A visitor enters the desk with a secret that works once, or through a proxy."""

import re
import socket
import sys
from html import unescape
from pathlib import Path
from urllib.parse import quote, urlencode, urlsplit

import pytest
from starlette.datastructures import FormData
from starlette.requests import Request

from pipeline.desk.app import ROUTES, DeskServer
from pipeline.desk.home import show_home
from pipeline.desk.login import MOST_FORM
from pipeline.desk.page_request import Desk, PageRequest
from pipeline.desk.users import User, read_users
from pipeline.errors import ConfigError
from pipeline.resources import RUBRICS
from pipeline.submission import load_submission
from tests.helpers.desks import (
    PROXY,
    Visitor,
    a_submission,
    at_lab,
    listed_user,
    write_users,
)
from tests.helpers.grades import write_class
from tests.helpers.waiting import PATIENCE, until

pytestmark = pytest.mark.usefixtures("all_work_here")
PATHS = [re.sub(r"\{\w+:nth\}", "0", re.sub(r"\{name(:path)?\}", "x.json", p)) for p, *_ in ROUTES]


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Start a desk with one submission."""
    folder = a_submission(tmp_path_factory.mktemp("desk") / "team")
    with DeskServer(folder=folder) as server:
        yield server


@pytest.fixture(scope="module")
def visitor(server):
    """Return a visitor who opened the printed address."""
    return Visitor.of(server.url)


def test_the_secret_opens_once_and_leaves_the_address(server, visitor):
    """The secret address works once and sets a cookie.

    No script can read the cookie, and no other site can send it. A second visitor with the same
    address is refused.
    """
    assert visitor.get("/").status == 200
    assert Visitor(port=visitor.port).get(urlsplit(server.url).path).status == 403
    again = visitor.get(urlsplit(server.url).path)
    assert (again.status, again.headers["location"]) == (303, "/student/0/")
    cookie = again.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert again.headers["referrer-policy"] == "no-referrer"
    secret = urlsplit(server.url).path.strip("/")
    assert secret not in visitor.headers["Cookie"]
    assert len(secret) >= 32


@pytest.mark.parametrize("path", PATHS)
def test_nobody_gets_in_without_the_cookie(visitor, path):
    """Without the right cookie every address answers 403."""
    for cookie in ("", f"cartlab-{visitor.port}=guess", "cartlab=x"):
        stranger = Visitor(port=visitor.port, headers={"Cookie": cookie})
        assert stranger.get(path).status == 403
        assert stranger.post(path).status == 403


FORM = "application/x-www-form-urlencoded"


def test_other_pages_cannot_ask(visitor, lab):
    """A request with another host, a foreign origin or a cross-site mark is refused.

    A second cookie of the same name, which any page on this computer could set, does not lock the
    visitor out. A link from another site may open a whole page of a lab server, but no part of a
    page and no form.
    """
    port, cookie = visitor.port, visitor.headers["Cookie"]
    for wrong in (
        {"Host": f"evil.example:{port}"}, {"Host": "127.0.0.1"}, {"Origin": "http://evil.example"},
        {"Origin": "null"}, {"Origin": f"http://127.0.0.1:{port + 1}"},
        {"Sec_Fetch_Site": "cross-site"}, {"Sec_Fetch_Site": "same-site"},
    ):  # fmt: skip
        assert visitor.get("/", **wrong).status == 403, wrong
        assert visitor.send("/open", b"folder=/", kind=FORM, **wrong).status == 403, wrong
    silent = visitor.ask("POST", "/open", b"", {"Content-Type": "text/plain"})
    assert silent.status == 403  # a browser sends the form's origin
    assert visitor.get("/", Host=f"localhost:{port}").status == 200

    other = f"cartlab-{port}=guess"
    for status, sent in (
        (200, f"{other}; {cookie}"), (200, f"{cookie}; {other}"), (403, f"{other}; {other}x"),
        (200, f"a=b; {other}; {other}x; {cookie}"),
    ):  # fmt: skip
        assert Visitor(port=port, headers={"Cookie": sent}).get("/").status == status, sent

    led = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}
    page = led | {"Sec_Fetch_Dest": "document"}
    assert lab("s1").get("/student/0/", **page).status == 200
    for part in (led | {"Sec_Fetch_Dest": "iframe"}, page | {"Sec_Fetch_Mode": "no-cors"}, led):
        assert lab("s1").get("/student/0/", **part).status == 403
    assert lab("s1").send("/student/0/fill", b"", kind=FORM, **page).status == 403


@pytest.mark.parametrize("path", ["/", "/nowhere", "/static/desk.js", "/student/7/"])
def test_every_answer_has_its_policy(visitor, path):
    """Each page's policy allows only the desk's own scripts and styles, and no frame around it."""
    for who in (visitor, Visitor(port=visitor.port)):
        policy = who.get(path).headers["content-security-policy"]
        assert "unsafe" not in policy
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert who.get(path).headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "length", [f"Content-Length: {MOST_FORM + 1}", "Transfer-Encoding: chunked"]
)
def test_a_request_that_is_too_long_is_refused(visitor, length):
    """A request that is too long is refused, whether it states its length or not.

    The desk still serves other requests.
    """
    host = f"127.0.0.1:{visitor.port}"
    head = (
        f"POST /open HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n{length}\r\n"
        f"Cookie: {visitor.headers['Cookie']}\r\n"
        "Content-Type: application/x-www-form-urlencoded\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", visitor.port), timeout=PATIENCE) as line:
        line.sendall(head.encode())
        if "chunked" in length:
            for _ in range(MOST_FORM // 100_000 + 1):
                line.sendall(b"186A0\r\n&a=" + b"x" * 99_997 + b"\r\n")
        assert line.recv(12) == b"HTTP/1.1 413"
    assert visitor.get("/").status == 200


def test_a_port_that_is_taken_is_one_line(server):
    """If the port is in use, the command ends with an error of one line."""
    port = urlsplit(server.url).port or 0
    with pytest.raises(ConfigError, match=f"port {port}"):
        DeskServer(port=port)


# ------------------------------------------------------------------------- a lab server

USERS = "".join([
    listed_user("s1", "student", folders='["one"]'),
    listed_user("s2", "student", folders='["two", "three"]'),
    listed_user("t", "ta", gradebooks='["grades"]'),
    listed_user("i", "instructor", folders='["one"]', gradebooks='["grades"]'),
    listed_user("w", "instructor", folders='["one"]', gradebooks='["grades"]', workshop='"shop"',
                ports='["/dev/ttyACM9"]'),
])  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Write the folders of a lab server."""
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def lab(root):
    """Start a desk for four people behind a proxy; return a visitor for each name."""
    for name in ("one", "two", "three", "four"):
        a_submission(root / name)
    write_class(root / "grades")
    (root / "shop").mkdir()
    (root / "shop" / "out").symlink_to(root)
    with at_lab(root, USERS) as visitor:
        yield visitor


@pytest.mark.parametrize("name", ["José Müller", "学生七"])
def test_a_name_may_come_in_utf_8_or_in_latin_1(name, tmp_path):
    """The proxy may send a user's name in UTF-8 or Latin-1; unknown names are refused."""
    a_submission(tmp_path / "one")
    with at_lab(tmp_path, listed_user(name, "student", folders='["one"]')) as named:
        utf_8 = name.encode().decode("latin-1")
        for sent in {utf_8, name} if name.isascii() or "é" in name else {utf_8}:
            assert named(sent).get("/student/0/").status == 200
        for other in (f"{utf_8}x", utf_8[:-1], "Jos\xc3", utf_8.encode().decode("latin-1")):
            assert named(other).get("/student/0/").status == 403


WRONG_LISTS = [
    ("", "", "proxy: is required"),
    ('"ta"', '"boss"', "role"),
    ('secret = "the', 'secrets = "the', "secret"),
    ("the-proxy-and-the-desk-know-it", "short", "secret"),
    ("X-Proxy-Secret", "x-remote-user", "header other"),
    ("127.0.0.1", "proxy.lab", "proxy.address"),
    ('"student"', '"ta"', "cannot have folders"),
    ('role = "ta"', 'role = "student"', "cannot have gradebooks"),
    ('"two"', '"twoo"', "not exist"),
    ('"shop"', '"shops"', "not exist"),
    ('name = "t"', 'name = "t"\nworkshop = "one"', "cannot have workshop"),
    ('name = "s1"', 'name = "s1"\nports = ["COM3"]', "cannot have ports"),
    ('"s2"', '"s1"', "listed twice"),
    ('"s2"', '"Ã¼"', "'Ã¼' in Latin-1"),
    ("folders", "folder", "'folders'"),
    ("https://Lab.example.edu", "lab", "site"),
]


def test_users_see_only_what_they_are_listed_for(lab):
    """Students at the same address each see their own folder, and a TA sees the listed gradebooks.

    An address with a number that no list reaches is answered with 404, whatever its length.
    """
    assert "one" in lab("s1").get("/student/0/").text
    assert "two" in lab("s2").get("/student/0/").text
    assert lab("s1").get("/student/1/").status == 404
    assert lab("s2").get("/student/1/").status == 200
    for path in ("/student/-1/", "/student/00000001/", "/student/1/report", "/student/../two/",
                 "/student/%2e%2e/", "/student/1/hand-in.zip"):  # fmt: skip
        assert lab("s1").get(path).status == 404, path
    assert lab("s1").post("/student/1/save", title="mine", seen="").status == 404
    assert lab("s1").upload("/student/1/files", [("a.csv", b"x")]).status == 404
    assert lab("s1").get("/").headers["location"] == "/student/0/"

    assert "team-07" in lab("t").get("/grades/0/").text
    assert lab("t").get("/grades/1/").status == 404

    for digits in ("9", "9" * 9, "9" * 10, "1" * 4_300, "1" * 9_000, "٣"):
        for name, path in (("s1", "/student/{}/"), ("t", "/grades/{}/"), ("s1", "/feedback/{}/")):
            assert lab(name).get(quote(path.format(digits))).status == 404, digits[:12]
        path = "/student/0/experiments/{}"
        assert lab("s1").post(quote(path.format(digits)), remove="1").status in (303, 404, 409, 422)


def test_students_and_tas_see_no_path_of_the_server(lab, root):
    """Students and TAs never see the path of a folder on the server.

    This holds for pages, refusals and progress messages. An instructor sees the paths.
    """
    plain = (root / "three" / "submission.toml").read_bytes()
    (root / "three" / "report").symlink_to(root)  # a link as report folder is refused
    try:
        said = [lab(name).get(path).text
                for name, paths in (("s1", ("", "report")), ("s2", ("", "report")))
                for path in (f"/student/0/{path}" for path in paths)]  # fmt: skip
        said += [lab("s2").get("/").text, lab("t").get("/grades/0/").text, lab("t").get("/").text]
        assert lab("s2").post("/student/1/make-report").status == 303
        news = lab("s2").get("/student/1/events").text
        assert "is a link" in news
        said += [news, lab("s2").get("/student/1/").text]
        (root / "three" / "submission.toml").write_bytes(b"x = [")
        said += [lab("s2").get("/student/1/").text]
        said += [lab("s2").post("/student/1/fill").text, lab("s2").get("/student/1/").text]
    finally:
        (root / "three" / "report").unlink()
        (root / "three" / "submission.toml").write_bytes(plain)
    assert not [text for text in said if str(root) in text or str(root.resolve()) in text]
    assert '<p class="kicker">one</p>' in said[0]
    assert str(root / "one") in lab("i").get("/student/0/").text


# For each kind of page, the users of a lab server who may open it.
ENTER = {"": "s t i w", "static": "s t i w", "student": "s i w", "grades": "t i w",
         "solution": "i w", "effects": "i w", "open": "", "grading": "", "exercises": "w",
         "rubric": "w", "bench": "w", "feedback": "s"}  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
def test_each_role_has_its_pages(lab, path):
    """A user who asks for a page of another role is refused, whatever the request contains."""
    for role, name in {"s": "s1", "t": "t", "i": "i", "w": "w"}.items():
        let_in = role in ENTER[path.split("/")[1]].split()
        if not let_in:
            answers = {lab(name).get(path).status, lab(name).post(path).status}
            assert 403 in answers <= {403, 405}, name
        elif path.endswith("/") and path != "/feedback/0/":  # none of these has a grade
            assert lab(name).get(path).status in (200, 303, 405), name


@pytest.mark.slow
@pytest.mark.sample
def test_opening_a_page_writes_nothing(lab, root):
    """A GET request for any page changes no file."""

    def files() -> dict:
        return {
            path: path.read_bytes()
            for path in root.rglob("*")
            if path.is_file() and not path.name.startswith("gradebook.sqlite-")
        }

    before = files()
    for path in (p for p, (_, method, _) in zip(PATHS, ROUTES, strict=True) if method == "GET"):
        for name in ("s1", "t", "i", "w"):
            lab(name).get(path)
    assert files() == before


def test_an_instructor_writes_only_in_the_workshop(lab, root):
    """An instructor writes exercises and rubrics only in the workshop.

    Only the ports in the file of users can be used.
    """
    who = lab("w")
    bench = {"preset": "throne-1dof", "folders": "1", "seed": "0"}
    made = who.post("/exercises/make", out="first", **bench)
    assert made.status == 303
    until(lambda: "The exercise is ready" in who.get(made.headers["location"]).text)
    assert load_submission(root / "shop" / "first").experiments
    rubric = (RUBRICS / "throne-1dof.toml").read_text(encoding="utf-8")
    assert who.post("/rubric/save", file="a.toml", text=rubric, seen="new").status == 303
    assert (root / "shop" / "a.toml").read_text(encoding="utf-8") == rubric.rstrip() + "\n"
    (root / "b.toml").write_text(rubric, encoding="utf-8")
    for out in ("../b", str(root / "b"), "~/b", "out/b", "first/../../b"):
        answer = who.post("/exercises/make", out=out, **bench)
        assert answer.status == 422, out
        page = who.get(f"/rubric/?{urlencode({'file': f'{out}.toml'})}")
        assert rubric.splitlines()[0] not in unescape(page.text), out
        assert who.post("/rubric/save", file=f"{out}.toml", text=rubric, seen="new").status == 422
    assert not (root / "b").exists()
    for port in ("/dev/ttyACM8", "socket://127.0.0.1:9", ""):
        assert who.post("/bench/0/acquire", port=port).status == 422
    assert "/dev/ttyACM9" in who.get("/bench/0/").text
    assert "/bench/0/" in who.get("/").text
    assert "/bench/0/" not in lab("i").get("/").text


def test_forged_names_are_refused(lab):
    """`ProxyLogin.enter` accepts only a request from the proxy with exactly one known name."""
    student = lab("s1")
    for who, status in (
        (lab(""), 403), (lab("root"), 403), (lab("s1", source="127.0.0.2"), 403), (student, 303),
        (Visitor(port=student.port, headers={"X-Remote-User": "s1"}), 403),
    ):  # fmt: skip
        assert who.get("/").status == status
    for headers in ({"X_Proxy_Secret": ""}, {"X_Proxy_Secret": "the-proxy-and-the-desk-know-i"},
                    {"X_Proxy_Secret": "wrong"}, {"Host": "127.0.0.1"}):  # fmt: skip
        assert student.get("/student/0/", **headers).status == 403
    assert student.get("/", X_Forwarded_For="127.0.0.2").status == 303
    double = "GET /student/0/ HTTP/1.1\r\nHost: lab.example.edu\r\n"
    double += "X-Proxy-Secret: the-proxy-and-the-desk-know-it\r\n"
    double += "X-Remote-User: s1\r\nX-Remote-User: s2\r\n\r\n"
    with socket.create_connection(("127.0.0.1", student.port), timeout=PATIENCE) as line:
        line.sendall(double.encode())
        assert line.recv(12) == b"HTTP/1.1 403"
    del student.headers["X-Proxy-Secret"]  # the user who logged in at the proxy
    assert student.get("/student/0/").status == 403


@pytest.mark.parametrize(("old", "new", "why"), WRONG_LISTS)
def test_a_wrong_list_is_one_line(old, new, why, tmp_path):
    """An error in the file of users is refused with a message that names it."""
    for name in ("one", "two", "three", "grades", "shop"):
        (tmp_path / name).mkdir()
    users = USERS.replace('"s1"', '"ü"') if "Latin" in why else USERS
    text = (PROXY + users).replace(old, new, 1) if old else ""
    (tmp_path / "users.toml").write_text(text, encoding="utf-8")
    (tmp_path / "users.toml").chmod(0o600)
    with pytest.raises(ConfigError, match=why):
        read_users(tmp_path / "users.toml")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")
def test_a_file_of_users_that_others_can_read_or_write_is_refused(tmp_path):
    """The file of users is refused if others can read it, or write to it or to its folder."""
    folder = tmp_path / "desk"
    folder.mkdir()
    path = write_users(folder, listed_user("s1", "student"))
    for file, inside, refused in ((0o644, 0o755, "chmod o-r"), (0o602, 0o755, "chmod o-w"),
                                  (0o600, 0o777, "can replace")):  # fmt: skip
        path.chmod(file)
        folder.chmod(inside)
        with pytest.raises(ConfigError, match=refused):
            read_users(path)
    folder.chmod(0o1777)  # as in /tmp, only its owner can replace a file there
    users, *_ = read_users(path)
    assert (users.header, users.site) == ("X-Remote-User", "https://lab.example.edu")


@pytest.mark.parametrize("top", ["/", "/static", "/student", "/grades"])
def test_pages_are_whole_wherever_the_data_lie(top):
    """Folders with the names of the desk's own addresses leave all links of a page as they are."""
    user = User(name="s", role="student", folders=[Path(top) / "team-a", Path(top) / "team-b"])
    desk = Desk()
    try:
        scope = {"type": "http", "method": "GET", "path": "/", "headers": [], "query_string": b""}
        request = Request({**scope, "path_params": {}})
        home = show_home(PageRequest(desk=desk, user=user, request=request, form=FormData()))
        page = bytes(home.body).decode()
    finally:
        desk.close()
    for address in ("/student/0/", "/student/1/", "/static/desk.css"):
        assert f'="{address}' in page
    assert f'"{top}"' not in page or top == "/"


@pytest.mark.parametrize("role", ["ta", "instructor"])
def test_a_message_names_places_only_by_their_names(role, tmp_path):
    """A message for students and TAs holds no path of their folders; an instructor sees it."""
    user = User(name="x", role=role, gradebooks=[tmp_path / "grades"])
    shown = user.name_places(f"{tmp_path}/grades/gradebook.sqlite: is a link")
    assert "grades/gradebook.sqlite" in shown
    assert (str(tmp_path) in shown) == (role == "instructor")
