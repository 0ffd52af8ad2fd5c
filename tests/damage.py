"""Ways in which files get damaged, by a seeded generator; what commands then say."""

from __future__ import annotations

import contextlib
import io
import json
import traceback
import zipfile
from typing import TYPE_CHECKING, Any

from crashhunt.base.integrity import digest_of_data
from crashhunt.cli import main

if TYPE_CHECKING:
    import random
    from pathlib import Path

JUNK: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    10**30,
    1e308,
    "",
    "x",
    "../../etc",
    "\ud800\x1b[2J",
    [],
    [[]],
    {},
    {"x": 1},
)


def command(*words: object) -> tuple[int, str, str]:
    """Run a command in this process: exit code, or -1 for a traceback; standard output; standard error."""
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as ended:
            code = ended.code
        except BaseException:
            traceback.print_exc(file=err)
            code = -1
    return int(code or 0), out.getvalue(), err.getvalue()  # type: ignore[call-overload]


def damage_bytes(path: Path, generator: random.Random) -> str:
    """Damage any file as disks and editors do."""
    data = bytearray(path.read_bytes())
    place = generator.randrange(len(data))
    kind = generator.choice(("bit", "cut", "zeros", "noise", "empty", "folder", "text", "gone", "longer"))
    if kind == "bit":
        data[place] ^= 1 << generator.randrange(8)
    elif kind == "cut":
        del data[place:]
    elif kind == "zeros":
        start = place // 512 * 512
        data[start : start + 512] = bytes(len(data[start : start + 512]))
    elif kind == "noise":
        data[place : place + 16] = generator.randbytes(16)
    elif kind == "longer":
        data += generator.randbytes(40)
    elif kind == "text":
        data = bytearray(b"what somebody wrote there by mistake\n" * 30)
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind != "gone":
        path.write_bytes(b"" if kind == "empty" else data)
    return f"{kind} at {place} of {path.name}"


def damage_json(data: Any, generator: random.Random) -> str:
    """Put something else into a JSON object, somewhere."""
    here, path = data, ""
    while True:
        keys = list(here) if isinstance(here, dict) else range(len(here))
        key = generator.choice(list(keys))
        path += f".{key}"
        if isinstance(here[key], dict | list) and here[key] and generator.random() < 0.7:
            here = here[key]
            continue
        kind = generator.choice(("junk", "junk", "junk", "drop", "deep"))
        if kind == "drop":
            del here[key]
        elif kind == "deep":
            here[key] = deep = []
            for _ in range(200):
                deep.append(deep := [])
        else:
            here[key] = generator.choice(JUNK)
        return f"{kind} in {path}: {str(here[key])[:20] if kind == 'junk' else ''}"


def damage_lines(path: Path, generator: random.Random) -> str:
    """Damage a text file as an editor does."""
    lines = path.read_text(encoding="utf-8").splitlines()
    place = generator.randrange(len(lines))
    key = lines[place].partition("=")[0]
    kind = generator.choice(("drop", "twice", "value", "value", "value", "deep"))
    if kind == "drop":
        del lines[place]
    elif kind == "twice":
        lines.insert(place, lines[place])
    elif kind == "deep":
        lines[place] = f"{key}= {'[' * 3000}{']' * 3000}"
    else:
        junk = ("-1", '"x"', "[]", "{}", "nan", "1e400", "9" * 5000, '"\\u0000"', "true", "1979-05-27")
        lines[place] = f"{key}= {generator.choice(junk)}"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return f"{kind} in line {place} of {path.name}: {lines[min(place, len(lines) - 1)][:40]}"


def damage_archive(path: Path, generator: random.Random, *, hashes: bool = True) -> str:
    """Damage a zip file: its bytes, its entries, its index; with hashes that fit, where somebody means it."""
    if generator.random() < 0.4:
        return damage_bytes(path, generator)
    import hashlib

    with zipfile.ZipFile(path) as archive:
        entries = {info.filename: archive.read(info) for info in archive.infolist()}
    index = json.loads(entries.pop("archive.json"))
    name = generator.choice(sorted(entries))
    kind = generator.choice(
        ("index", "data", "json", "json", "json", "json", "lines", "drop", "twice", "name", "method")
    )
    what = name
    methods = (zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_STORED)
    method = generator.choice(methods)
    if kind == "index":
        what = damage_json(index, generator)
    elif kind == "data":
        entries[name] = generator.randbytes(50)
    elif kind == "json":
        name = generator.choice([name for name in sorted(entries) if name.endswith(".json")])
        data = json.loads(entries[name])
        data.pop("integrity", None)
        what = f"{name}: {damage_json(data, generator)}"
        data["integrity"] = digest_of_data(data)
        entries[name] = json.dumps(data).encode()
    elif kind == "lines":
        name = generator.choice([name for name in sorted(entries) if name.endswith(".toml")])
        place = path.with_name("lines.toml")
        place.write_bytes(entries[name])
        what = damage_lines(place, generator)
        entries[name] = place.read_bytes()
        place.unlink()
    elif kind == "drop":
        del entries[name]
        if generator.random() < 0.5:
            index["files"].pop(name)
    elif kind == "name":
        other = generator.choice(
            ("../x", "/x", "a\\b", "crashes/", "crashes", "hunt.toml/x", "\x1b[2J", "crashes/x\ny")
        )
        entries[other] = b"x"
        index["files"][other] = {"size": 1, "blake2b": "0" * 32}
    if (
        hashes
        and isinstance(index.get("files"), dict)
        and isinstance(index["files"].get(name), dict)
        and name in entries
    ):
        digest = hashlib.blake2b(entries[name], digest_size=16).hexdigest()
        index["files"][name] = {"size": len(entries[name]), "blake2b": digest}
    with zipfile.ZipFile(path, "w", method) as archive, _quiet():
        for entry, data in entries.items():
            archive.writestr(entry, data)
            if kind == "twice" and entry == name:
                archive.writestr(entry, data)
        archive.writestr("archive.json", json.dumps(index))
    if kind == "method":  # what is packed no longer is
        data = bytearray(path.read_bytes())
        for _ in range(20):
            data[generator.randrange(40, len(data) // 2)] ^= 0x55
        path.write_bytes(data)
    return f"{kind} {what} packed as {method}"


def _quiet() -> Any:
    import warnings

    quiet = warnings.catch_warnings()
    quiet.__enter__()
    warnings.simplefilter("ignore")  # zipfile warns of names that come twice
    stack = contextlib.ExitStack()
    stack.callback(quiet.__exit__, None, None, None)
    return stack
