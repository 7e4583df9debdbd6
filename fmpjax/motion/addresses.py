"""Motion files at an address: of a web server (``https://``), or of a data set on the Hugging Face hub (``hf://``).

A file is downloaded once into the user's cache folder. Later its server is asked whether it still is the same file. The
cache is bounded: the files whose last use is the longest ago leave it. Whatever a file holds, only the readers of
`fmpjax.motion` see it, and they run nothing that is in it.
"""

import contextlib
import hashlib
import importlib.util
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import SplitResult, unquote, urlsplit

from fmpjax import files, machine
from fmpjax.errors import UserError

MOST_BYTES = 1 << 28  # of a file
MOST_KEPT = 1 << 31  # bytes of all files of the cache
FRESH = 60.0  # s, for which a file is taken for the server's without asking again: a command reads it several times
CONNECT, READ = 20.0, 60.0  # s, to wait for a server and for its next bytes
CHUNK = 1 << 20  # bytes
OURS = ("127.0.0.1", "::1", "localhost")  # hosts that may do without encryption
NEEDED = {"hf": ("fsspec", "huggingface_hub"), "https": ("fsspec", "aiohttp")}  # packages, those of the extra `hub`
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_DATA_SET = re.compile(r"hf://datasets/([^/@]+/[^/@]+)(?:@([^/@]+))?(?:/(.*))?")
_FORM = "expected https://HOST/FILE or hf://datasets/OWNER/NAME[@REVISION]/FILE"


class Version(NamedTuple):
    """What a server says of a file."""

    tag: str | None  # changes with the file; None where the server says nothing of the kind
    size: int | None  # bytes


def is_address(name: str | os.PathLike) -> bool:
    """Whether a motion is named by an address and not by a name or a path."""
    return isinstance(name, str) and _ADDRESS.match(name) is not None


def file_name(name: str | os.PathLike) -> str:
    """The file's name at the end of an address or a path; what is not printable is left out."""
    if not is_address(name):
        return Path(name).name
    end = Path(unquote(_split(str(name)).path)).name
    return "".join(sign for sign in end if sign.isprintable())


def shareable(name: str) -> bool:
    """Whether a name is an address without a password or a key in it, which others may see."""
    parts = _split(name) if is_address(name) else None
    return parts is not None and not parts.query and (parts.scheme == "hf" or "@" not in parts.netloc)


def local(name: str | os.PathLike) -> Path:
    """The file on this machine: of an address its copy in the cache, of a path the path itself.

    Raises:
      UserError: see `fetch`.
    """
    return fetch(str(name)) if is_address(name) else Path(name)


def listed(address: str, suffixes: Sequence[str]) -> list[str] | None:
    """Addresses of the files with these suffixes that a data set's folder or pattern stands for; None for one file.

    Raises:
      UserError: the data set cannot be read, or holds no such files there.
    """
    found = _DATA_SET.fullmatch(address)
    if _scheme(address) != "hf" or found is None:
        return None
    pattern = any(sign in (found[3] or "") for sign in "*?[")
    if not pattern and Path(found[3] or "").suffix in suffixes:
        return None
    check_license(address)
    path = address.removeprefix("hf://").rstrip("/")
    with _explained(address):
        system = _hub()
        if not pattern and not system.isdir(path):
            return None
        names = system.glob(path) if pattern else system.ls(path, detail=False)
    chosen = [f"hf://{name}" for name in sorted(names) if Path(name).suffix in suffixes]
    if not chosen:
        what = "no motion file matches the pattern" if pattern else "no motion files are in the folder"
        raise UserError(f"{what} {address}: expected files that end in {', '.join(suffixes)}")
    return chosen


def fetch(address: str) -> Path:
    """The file at an address, from the cache where it still is what its server has.

    What was fetched, and that a file has changed, is said on standard error, with the start of its SHA-256. Without its
    server a copy is used, which is said, too.

    Raises:
      UserError: it is no address of a file, its license is not accepted, it is too large, or there is neither server
        nor copy.
    """
    scheme, name = _scheme(address), file_name(address)
    if not name or address.endswith("/") or (scheme == "hf" and not (_DATA_SET.fullmatch(address) or [""] * 4)[3]):
        raise UserError(f"{address} names no file: {_FORM}")
    folder = _cache() / hashlib.sha256(address.encode()).hexdigest()[:24]
    file = folder / "file" / name
    record = _record(folder, file)
    if record and 0 <= time.time() - record["checked"] < FRESH:
        return file
    if scheme == "hf":
        check_license(address)
    try:
        with _explained(address):
            version = _version(address)
    except _Unreachable as error:
        if record is None:
            raise
        _say(f"{error.sentence}; the copy of {_day(record)} is used")
        os.utime(folder)
        return file
    if record is None or version.tag is None or version.tag != record["tag"]:
        record = _download(address, version, folder, file, record)
    _keep(folder, record | {"checked": time.time()})
    return file


def license_of(address: str) -> str | None:
    """The license of an address's data set, as it was accepted on this machine; None for other motions."""
    found = _DATA_SET.fullmatch(address)
    return _accepted().get(found[1]) if found else None


def check_license(address: str, *, accept: bool = False) -> None:
    """Show the license of an address's data set and ask whether it is accepted, once on this machine.

    Args:
      address: of a data set, or of anything else, which has no license to show.
      accept: it is accepted without a question.

    Raises:
      UserError: it is not accepted, there is no terminal to ask, or the hub cannot be reached.
    """
    if _scheme(address) != "hf" or (data_set := _data_set(address)) in (accepted := _accepted()):
        return
    with _explained(address):
        card = _hub_api().dataset_info(data_set).card_data
    told = card.to_dict() if card else {}
    named = told.get("license_name") or told.get("license") or "that its card does not name"
    named = ", ".join(named) if isinstance(named, list) else str(named)
    sentence = f"the data set {data_set} has the license {named} ({told.get('license_link') or _card(data_set)})"
    if accept:
        _say(f"{sentence}, which is accepted")
    elif sys.stdin is None or not sys.stdin.isatty():
        raise UserError(
            f"{sentence}, which you have not accepted yet: expected --accept-license, or fmpjax.motion.accept_license "
            "in Python, or a terminal to ask"
        )
    else:
        _say(f"{sentence[0].upper()}{sentence[1:]}.")
        try:
            answer = input("Do you accept it? [y/N] ")
        except EOFError:
            answer = ""
        if answer.strip().lower() not in ("y", "yes"):
            raise UserError(f"{sentence}, which is not accepted: expected y")
    with _writing():
        _cache().mkdir(parents=True, exist_ok=True)
        files.write(_cache() / "licenses.json", json.dumps(accepted | {data_set: named}, indent=1))


def _card(data_set: str) -> str:
    return f"{(_endpoint() or 'https://huggingface.co').rstrip('/')}/datasets/{data_set}"


def _accepted() -> dict[str, str]:
    """License of each data set for which it was accepted."""
    try:
        found = json.loads((_cache() / "licenses.json").read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


# --- the servers -----------------------------------------------------------------------------------------------------


def _split(address: str) -> SplitResult:
    """The parts of an address; a file's name on the hub may hold ``?`` and ``#``."""
    try:
        parts = urlsplit(address)
    except ValueError:  # such as a bracket that is not closed
        raise UserError(f"{address} is no address of a motion: {_FORM}") from None
    if parts.scheme != "hf":
        return parts
    return parts._replace(path=address.removeprefix(f"hf://{parts.netloc}"), query="", fragment="")


def _scheme(address: str) -> str:
    """Scheme of an address, "https" or "hf", once its form is known to be good and its packages to be there."""
    parts = _split(address)
    if parts.scheme == "http" and parts.hostname not in OURS:
        raise UserError(f"{address} is not encrypted: {_FORM}")
    known = {"https": bool(parts.hostname), "http": True, "hf": _DATA_SET.fullmatch(address) is not None}
    if not known.get(parts.scheme):
        raise UserError(f"{address} is no address of a motion: {_FORM}")
    scheme = "hf" if parts.scheme == "hf" else "https"
    for package in NEEDED[scheme]:
        if importlib.util.find_spec(package) is None:
            raise UserError(f"{address} needs the package {package}, which is missing: pip install 'fmpjax[hub]'")
    return scheme


def _data_set(address: str) -> str:
    found = _DATA_SET.fullmatch(address)
    assert found is not None, "the scheme was checked"
    return found[1]


def _endpoint() -> str | None:
    """Address of the hub where it is not Hugging Face's own; read at each call, which the hub's package does not do."""
    return os.environ.get("HF_ENDPOINT") or None


def _hub_api() -> Any:
    from huggingface_hub import HfApi

    return HfApi(endpoint=_endpoint())


def _hub() -> Any:
    from huggingface_hub import HfFileSystem

    return HfFileSystem(endpoint=_endpoint(), skip_instance_cache=True)


def _system(address: str) -> tuple[Any, str]:
    """The file system that an address is of, and its path there."""
    if address.startswith("hf://"):
        return _hub(), address.removeprefix("hf://")
    import aiohttp
    import fsspec

    # A large file may take its time. A server that says nothing may not.
    timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT, sock_read=READ)
    return fsspec.filesystem("http", client_kwargs={"timeout": timeout}, skip_instance_cache=True), address


def _version(address: str) -> Version:
    """What the server says of a file."""
    system, path = _system(address)
    told = system.info(path)
    if told.get("type") == "directory":
        raise FileNotFoundError("it is a folder, and one file was expected")
    marks = told.get("blob_id"), told.get("ETag"), told.get("Last-Modified")
    return Version(next((str(mark) for mark in marks if mark), None), told.get("size"))


def _download(address: str, version: Version, folder: Path, file: Path, before: dict | None) -> dict[str, Any]:
    """Write the file whole or not at all; its record."""
    if (version.size or 0) > MOST_BYTES:
        raise UserError(_too_large(address))
    with _writing():
        file.parent.mkdir(parents=True, exist_ok=True)
        digest, size = hashlib.sha256(), 0
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".", delete=False) as out:
            partial = Path(out.name)
        try:
            with partial.open("wb") as out, _explained(address):
                system, path = _system(address)
                with system.open(path, "rb", block_size=0) as source:
                    while part := source.read(CHUNK):
                        size += len(part)
                        if size > MOST_BYTES:
                            raise UserError(_too_large(address))
                        digest.update(part)
                        out.write(part)
            if version.size is not None and size != version.size:
                raise UserError(f"{address} ended after {size:,} bytes: expected {version.size:,}, try it again")
            partial.chmod(0o644)
            os.replace(partial, file)
        finally:
            partial.unlink(missing_ok=True)
    record = {"address": address, "tag": version.tag, "sha256": digest.hexdigest(), "fetched": time.time()}
    if before is None:
        _say(f"fetched {address}: {size / 1e6:.3g} MB, sha256 {record['sha256'][:12]}")
    elif before["sha256"] != record["sha256"]:
        old, new = before["sha256"][:12], record["sha256"][:12]
        _say(f"{address} has changed since {_day(before)}: its sha256 was {old} and is {new}; the new file is used")
    return record


def _too_large(address: str) -> str:
    return f"{address} is too large: expected at most {MOST_BYTES:,} bytes"


class _Unreachable(UserError):
    """A server cannot be reached, or refuses."""

    def __init__(self, address: str, reason: str):
        self.sentence = f"{address} cannot be fetched ({reason})"
        super().__init__(f"{self.sentence}: expected a file that can be read from here")


@contextlib.contextmanager
def _explained(address: str):
    """One sentence in place of what the libraries of each server raise."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # each library of a server has errors of its own
        # A cause says more than the error made from it: refused, unknown host, status 403.
        cause = error.__cause__ or error
        text = next((line.strip() for line in str(cause).splitlines() if line.strip()), type(cause).__name__)
        raise _Unreachable(address, text[:200].rstrip(".")) from error


# --- the cache -------------------------------------------------------------------------------------------------------


def _cache() -> Path:
    folder = machine.cache_folder("motions")
    if folder is None:
        raise UserError("no cache folder can be written: expected a home folder, or one in XDG_CACHE_HOME")
    return folder


@contextlib.contextmanager
def _writing():
    """One sentence where the cache cannot be written."""
    try:
        yield
    except OSError as error:
        raise UserError(f"the cache {_cache()} cannot be written: {error.strerror or error}") from error


def _record(folder: Path, file: Path) -> dict[str, Any] | None:
    """What is known of a copy; None where there is none, or where it is not what was fetched."""
    try:
        record = json.loads((folder / "record.json").read_text())
        whole = hashlib.sha256(file.read_bytes()).hexdigest() == record["sha256"]
        return record if whole and {"tag", "fetched", "checked"} <= set(record) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _keep(folder: Path, record: dict[str, Any]) -> None:
    """Write a copy's record, and drop the copies that were used the longest ago where all are too large together."""
    with _writing():
        files.write(folder / "record.json", json.dumps(record, indent=1))
    with contextlib.suppress(OSError):  # another process may drop the same ones
        os.utime(folder)
        size, held = 0, [path for path in _cache().iterdir() if path.is_dir()]
        for used in sorted(held, key=lambda path: path.stat().st_mtime, reverse=True):
            size += sum(path.stat().st_size for path in used.rglob("*") if path.is_file())
            if size > MOST_KEPT and used != folder:
                shutil.rmtree(used, ignore_errors=True)


def _day(record: dict[str, Any]) -> str:
    return time.strftime("%Y-%m-%d", time.localtime(record["fetched"]))


def _say(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)
