"""Motions at addresses: a web server and a stand-in for the Hugging Face hub, both of this machine."""

import hashlib
import json
import pickle
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np
import pytest

from fmpjax import cli, deploy, motion
from fmpjax.errors import UserError
from fmpjax.motion import addresses, formats, library

pytest.importorskip("aiohttp", reason="fmpjax[hub] is not installed")
pytest.importorskip("huggingface_hub", reason="fmpjax[hub] is not installed")

SET = "hf://datasets/someone/walks"


class Server(ThreadingHTTPServer):
    """Files by path, and the part of the hub's interface that reading a data set takes."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.data_set: dict[str, bytes] = {}  # of someone/walks
        self.card: dict[str, object] = {"license": "cc-by-nc-4.0"}
        self.tags = True  # whether it says when a file changes
        self.lie: int | None = None  # a size that it states in place of a file's
        self.asked: list[str] = []
        self.url = f"http://127.0.0.1:{self.server_address[1]}"

    def count(self, what: str) -> int:
        return sum(line.startswith(what) for line in self.asked)


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.answer()

    def do_GET(self):
        self.answer()

    def do_POST(self):
        self.answer(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))

    def answer(self, body=None):
        parts = urlsplit(self.path)
        path, server = unquote(parts.path), self.server
        server.asked.append(f"{self.command} {path}")
        if path.startswith("/api/datasets/someone/walks"):
            return self.hub(path.removeprefix("/api/datasets/someone/walks"), parts.query, body)
        if path.startswith("/datasets/someone/walks/resolve/main/"):
            return self.file(server.data_set.get(path.removeprefix("/datasets/someone/walks/resolve/main/")))
        self.file(server.files.get(path.lstrip("/")))

    def hub(self, rest, query, body):
        held, where = self.server.data_set, rest.partition("/tree/main")[2].strip("/")
        if rest in ("", "/revision/main"):
            return self.json({"id": "someone/walks", "sha": "0" * 40, "cardData": self.server.card, "siblings": []})
        if rest.startswith("/paths-info/"):
            asked = body["paths"] if isinstance(body, dict) else []
            known = [entry(path, held[path]) for path in asked if path in held]
            return self.json([*known, *map(entry, folders(held) & set(asked))])
        below = {name for name in {*held, *folders(held)} if not where or name.startswith(f"{where}/")}
        if parse_qs(query).get("recursive", ["false"])[0].lower() != "true":
            below = {name for name in below if "/" not in name.removeprefix(where).lstrip("/")}
        if not below:
            return self.file(None)
        self.json([entry(name, held.get(name)) for name in sorted(below)])

    def json(self, value):
        self.send(200, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def file(self, content):
        if content is None:
            return self.send(404, b"", {"X-Error-Code": "EntryNotFound"})
        tags = {"ETag": f'"{hashlib.sha1(content).hexdigest()}"'} if self.server.tags else {}
        self.send(200, content, tags | {"X-Repo-Commit": "0" * 40})

    def send(self, status, content, headers):
        self.send_response(status)
        size = len(content) if self.server.lie is None else self.server.lie
        for name, value in {"Content-Length": str(size), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


def folders(files):
    return {str(folder) for name in files for folder in Path(name).parents} - {"."}


def entry(path, content=None):
    """A file as the hub describes it, or a folder."""
    if content is None:
        return {"type": "directory", "path": path, "oid": "f" * 40, "size": 0}
    return {"type": "file", "path": path, "size": len(content), "oid": hashlib.sha1(content).hexdigest()}


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A server, a cache of its own, and every file asked for again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(addresses, "FRESH", 0.0)
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hub"))
    with Server() as made:
        monkeypatch.setenv("HF_ENDPOINT", made.url)
        thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        yield made
        made.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def walking():
    return formats.locate("walk").read_bytes()


@pytest.fixture(scope="module")
def turning():
    return formats.locate("turn_left").read_bytes()


# --- a web server ----------------------------------------------------------------------------------------------------


def test_an_address_is_a_motion_that_is_fetched_once(server, walk, walking, capsys):
    server.files["clips/My walk.npz"] = walking
    address = f"{server.url}/clips/My%20walk.npz"
    clip = motion.load(address)
    np.testing.assert_array_equal(clip.qpos, walk.qpos)
    assert clip.name == "My walk" and library.title(address) == "My walk"
    said = capsys.readouterr().err
    assert f"fetched {address}: " in said and hashlib.sha256(walking).hexdigest()[:12] in said
    fetched = server.count("GET")
    motion.load(address)
    assert server.count("GET") == fetched and capsys.readouterr().err == ""


def test_a_file_is_not_asked_for_again_at_once(server, walking, monkeypatch):
    server.files["a.npz"] = walking
    monkeypatch.setattr(addresses, "FRESH", 60.0)
    motion.load(f"{server.url}/a.npz")
    asked = len(server.asked)
    motion.load(f"{server.url}/a.npz")
    assert len(server.asked) == asked


@pytest.mark.parametrize("tags", [True, False])
def test_a_changed_file_is_noticed(server, walking, turning, capsys, tags):
    server.tags, server.files["a.npz"] = tags, walking
    address = f"{server.url}/a.npz"
    motion.load(address)
    server.files["a.npz"] = turning
    np.testing.assert_array_equal(motion.load(address).qpos, motion.load("turn_left").qpos)
    old, new = (hashlib.sha256(content).hexdigest()[:12] for content in (walking, turning))
    assert f"its sha256 was {old} and is {new}; the new file is used" in capsys.readouterr().err
    motion.load(address)
    assert capsys.readouterr().err == ""


def test_without_its_server_the_copy_is_used(server, walking, capsys):
    server.files["a.npz"] = walking
    file = addresses.fetch(f"{server.url}/a.npz")
    del server.files["a.npz"]
    assert addresses.fetch(f"{server.url}/a.npz") == file
    said = capsys.readouterr().err
    assert "a.npz cannot be fetched (404" in said and "; the copy of " in said
    with pytest.raises(UserError, match=r"/b\.npz cannot be fetched \(404.*\): expected a file that can be read"):
        addresses.fetch(f"{server.url}/b.npz")


def test_a_damaged_copy_is_fetched_again(server, walking, capsys):
    server.files["a.npz"] = walking
    file = addresses.fetch(f"{server.url}/a.npz")
    file.write_bytes(b"half")
    assert addresses.fetch(f"{server.url}/a.npz").read_bytes() == walking
    (file.parents[1] / "record.json").write_text("[]")
    assert addresses.fetch(f"{server.url}/a.npz").read_bytes() == walking


def test_files_and_cache_are_bounded(server, walking, monkeypatch):
    server.files |= {name: walking for name in ("a.npz", "b.npz", "c.npz")}
    monkeypatch.setattr(addresses, "MOST_KEPT", 2 * len(walking) + 2000)
    files = [addresses.fetch(f"{server.url}/{name}") for name in ("a.npz", "b.npz", "a.npz", "c.npz")]
    assert [file.exists() for file in files] == [True, False, True, True]
    monkeypatch.setattr(addresses, "MOST_BYTES", 1000)
    server.files["d.npz"] = walking
    with pytest.raises(UserError, match=r"d\.npz is too large: expected at most 1,000 bytes"):
        addresses.fetch(f"{server.url}/d.npz")


def test_a_file_that_ends_early_is_refused(server, walking):
    server.files["a.npz"], server.lie = walking, len(walking) + 10
    with pytest.raises(UserError, match=r"a\.npz (ended after|cannot be fetched)"):
        addresses.fetch(f"{server.url}/a.npz")
    assert not list(Path(addresses._cache()).rglob("*.npz"))


def test_a_pickle_from_the_network_runs_nothing(server, tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    server.files["trap.pkl"] = pickle.dumps({"fps": 30, "root_pos": Trap()})
    with pytest.raises(UserError, match="trap.pkl"):
        motion.load(f"{server.url}/trap.pkl")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("ftp://host/a.npz", "ftp://host/a.npz is no address of a motion: expected https://HOST/FILE or hf://datasets"),
        ("https:///a.npz", "https:///a.npz is no address of a motion"),
        ("https://[host/a.npz", r"https://\[host/a.npz is no address of a motion"),
        ("https://host/", "https://host/ names no file: expected https://HOST/FILE"),
        ("http://host/a.npz", "http://host/a.npz is not encrypted: expected https://HOST/FILE"),
        ("hf://someone/model/a.npz", "hf://someone/model/a.npz is no address of a motion"),
        ("hf://datasets/walks", "hf://datasets/walks is no address of a motion"),
        (f"{SET}/", "names no file"),
    ],
)
def test_bad_addresses(address, sentence):
    with pytest.raises(UserError, match=sentence.replace("(", r"\(")):
        motion.load(address)


@pytest.mark.parametrize(("address", "package"), [("https://h/a.npz", "aiohttp"), (f"{SET}/a.npz", "huggingface_hub")])
def test_a_missing_package_is_one_sentence(monkeypatch, address, package):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == package else object())
    with pytest.raises(UserError, match=rf"needs the package {package}, which is missing: pip install 'fmpjax\[hub\]'"):
        motion.load(address)


def test_addresses_in_lists():
    names = f"https://h/a.npz,walk:2,{SET}/b.npz:0.5,https://h:8080/c.csv,https://h/d.npz:3"
    assert library.parse(names) == [
        ("https://h/a.npz", 1.0), ("walk", 2.0), (f"{SET}/b.npz", 0.5), ("https://h:8080/c.csv", 1.0),
        ("https://h/d.npz", 3.0),
    ]  # fmt: skip
    assert library.listed(names) == names
    with pytest.raises(UserError, match="has weight 'much'"):
        library.parse("https://h/a.npz:much")


def test_who_sees_an_address():
    """An export keeps an address that others may have, and cuts one with a key in it to the file's name."""
    assert addresses.shareable(f"{SET}/a.npz") and addresses.shareable("https://h/a.npz")
    for name in ("https://h/a.npz?key=secret", "https://me:secret@h/a.npz", "/home/me/a.npz", "walk"):
        assert not addresses.shareable(name)
    assert addresses.file_name("https://h/in/a%2Fb.npz?key=secret") == "b.npz"
    assert addresses.file_name(f"{SET}/in/a #2?.npz") == "a #2?.npz"


# --- the hub ---------------------------------------------------------------------------------------------------------


def test_a_license_is_asked_for_once(server, walk, walking, monkeypatch, capsys):
    server.data_set["g1/walk.npz"] = walking
    address = f"{SET}/g1/walk.npz"
    with pytest.raises(UserError) as refused:
        motion.load(address)
    sentence = str(refused.value)
    assert sentence.startswith(f"the data set someone/walks has the license cc-by-nc-4.0 ({server.url}/datasets/")
    assert "expected --accept-license" in sentence and "\n" not in sentence
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda prompt: "n")
    with pytest.raises(UserError, match="which is not accepted: expected y"):
        motion.load(address)
    assert server.count("GET /datasets/") == 0, "nothing is fetched before"
    monkeypatch.setattr("builtins.input", lambda prompt: "Yes")
    capsys.readouterr()
    np.testing.assert_array_equal(motion.load(address).qpos, walk.qpos)
    assert "The data set someone/walks has the license cc-by-nc-4.0" in capsys.readouterr().err
    monkeypatch.setattr("builtins.input", lambda prompt: pytest.fail("asked again"))
    motion.load(address)
    assert addresses.license_of(address) == "cc-by-nc-4.0" and addresses.license_of("walk") is None
    origin = deploy.model_card._license(address, None)
    assert origin == "cc-by-nc-4.0, as its data set's card says"


@pytest.mark.parametrize(
    ("card", "named"),
    [
        ({"license": ["mit", "cc0-1.0"]}, "mit, cc0-1.0"),
        ({"license": "other", "license_name": "our-terms", "license_link": "https://h/terms"}, "our-terms (https://h/"),
        ({}, "that its card does not name"),
    ],
)
def test_what_a_card_says(server, card, named):
    server.card = card
    with pytest.raises(UserError) as refused:
        addresses.check_license(f"{SET}/a.npz")
    assert f"the data set someone/walks has the license {named}" in str(refused.value)


def test_a_changed_file_of_a_data_set_is_noticed(server, walking, turning, capsys):
    server.data_set["a.npz"] = walking
    motion.accept_license(f"walk,{SET}/a.npz:2")
    assert "has the license cc-by-nc-4.0" in capsys.readouterr().err
    assert addresses.fetch(f"{SET}/a.npz").read_bytes() == walking
    fetched = server.count("GET /datasets/")
    addresses.fetch(f"{SET}/a.npz")
    assert server.count("GET /datasets/") == fetched
    server.data_set["a.npz"] = turning
    assert addresses.fetch(f"{SET}/a.npz").read_bytes() == turning
    assert "has changed since" in capsys.readouterr().err
    with pytest.raises(UserError, match="missing.npz cannot be fetched"):
        addresses.fetch(f"{SET}/missing.npz")


def test_folders_and_patterns_of_a_data_set(server, walking):
    server.data_set |= {name: walking for name in ("g1/b.npz", "g1/a.csv", "g1/more/c.npz", "g1/readme.md", "d.npz")}
    motion.accept_license(SET)
    assert library.listed(f"{SET}/g1") == f"{SET}/g1/a.csv:0.5,{SET}/g1/b.npz:0.5"
    assert library.listed(f"{SET}/g1/*.npz:2,walk") == f"{SET}/g1/b.npz:2,walk"
    assert library.listed(f"{SET}/**/*.npz:3") == f"{SET}/d.npz:1,{SET}/g1/b.npz:1,{SET}/g1/more/c.npz:1"
    assert library.listed(SET) == f"{SET}/d.npz:1"
    with pytest.raises(UserError, match=r"no motion file matches the pattern .*x\*: expected files that end in \.npz"):
        library.listed(f"{SET}/x*")


# --- commands --------------------------------------------------------------------------------------------------------


def command(*words):
    """Exit code of a command."""
    try:
        cli.main([str(word) for word in words])
    except SystemExit as stop:
        return stop.code
    return 0


def test_commands_take_addresses(server, walk, walking, tmp_path, capsys):
    server.files["b.npz"], server.data_set["a.npz"] = walking, walking
    imported = ("motion", "import", f"{SET}/a.npz", f"{server.url}/b.npz", "--out", tmp_path / "out")
    assert command(*imported) == 2
    assert "has the license cc-by-nc-4.0" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert command(*imported, "--accept-license") == 0
    for name in ("a.npz", "b.npz"):
        np.testing.assert_allclose(motion.load(tmp_path / "out" / name).qpos, walk.qpos)
    assert command("motion", "check", f"{SET}/a.npz") == 0
    server.files["c.bvh"] = b"HIERARCHY nonsense"
    assert command("motion", "retarget", f"{server.url}/c.bvh", "--out", tmp_path / "c.npz") == 2
    assert "c.bvh" in capsys.readouterr().err.splitlines()[-1]


def test_a_training_asks_for_the_license_before_there_is_a_run(server, walking, tmp_path, capsys):
    server.data_set["a.npz"] = walking
    train = ("train", "--preset", "smoke", "--motion", f"walk,{SET}/a.npz", "--run", tmp_path / "run")
    assert command(*train) == 2
    said = capsys.readouterr().err.strip()
    assert "has the license cc-by-nc-4.0" in said and "\n" not in said and not (tmp_path / "run").exists()
