# SPDX-License-Identifier: Apache-2.0
"""Sound inputs altered: bytes, plain data, documents, archives, messages."""

from __future__ import annotations

import copy
import io
import json
import random
import re
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import yaml

#: Values that no reader should trust.
HOSTILE: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, -(2**31), 2**63, 2**64, -(2**63) - 1, 10**400, 0.0, -0.0, 1e-320, 1e308, -1e308,
    float("nan"), float("inf"), float("-inf"), "", " ", "\x00", "\n", "\x1b[2J", "nan", "1e999", "../../etc/passwd",
    "/dev/null", "%s%n", "${HOME}", "x" * 5000, "é\U0001f916\u202e", [], [[]], [None], [1, "a"], {}, {"": None},
    {"a": {"b": []}}, [0.0] * 3, ["x"] * 300,
)  # fmt: skip

#: Texts that are hostile to parsers of YAML, JSON and XML.
TEXTS: tuple[bytes, ...] = (
    b"", b"\x00", b"\xff\xfe\x00", b"\xef\xbb\xbf{}", b"null", b"[]", b"0", b"'", b"{", b"}", b"- - - -", b"?: ?",
    b"%YAML 9",
    b"[" * 20_000, b"{a: " * 5_000, b"<a>" * 20_000, b'{"a":' * 20_000, b"!!python/object/apply:os.system [ls]",
    b"\t- x",
    b"a: &a [1]\nb: *a", b"a: &a [*a]", b"9" * 6_000, b"2001-99-99", b"a: 0x", b"0" * 500_000,
    b"a: &a [x,x,x,x]\n" + b"".join(b"%c: &%c [*%c,*%c,*%c]\n" % (i + 1, i + 1, i, i, i) for i in range(97, 110)),
    b'<!DOCTYPE r [<!ENTITY a "xxxxxxxxxx">'
    + b"".join(b'<!ENTITY %c "%s">' % (i + 1, b"&%c;" % i * 10) for i in range(97, 107))
    + b"]><robot name='&j;'/>",
    b'<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="&a;"/>',
)  # fmt: skip


def altered_bytes(sound: bytes, rng: random.Random) -> bytes:
    """Change, cut, repeat or insert some bytes; sometimes two alterations."""
    data = bytearray(sound)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(data) + 1)
        length = min(rng.choice((1, 2, 4, 8, 64, 1024)), len(data) - at)
        way = rng.randrange(7)
        if way <= 2:  # single bytes
            for _ in range(rng.choice((1, 2, 8))):
                if data:
                    data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        elif way == 3:  # a number
            data[at : at + length] = rng.choice((b"\0", b"\xff", b"\x7f")) * length
        elif way == 4:
            del data[at:]
        elif way == 5:
            del data[at : at + length]
        else:
            data[at:at] = data[at : at + length] * rng.choice((1, 2, 100))
    return bytes(data)


def altered_tree(sound: Any, rng: random.Random) -> Any:
    """Return plain data with some values replaced, left out, renamed or doubled."""
    tree = copy.deepcopy(sound)
    for _ in range(rng.choice((1, 1, 2, 4))):
        places = list(_places(tree))
        if not places:
            return rng.choice(HOSTILE)
        parent, key = rng.choice(places)
        way = rng.randrange(10)
        if way <= 5:
            parent[key] = _near(parent[key], rng) if rng.random() < 0.4 else copy.deepcopy(rng.choice(HOSTILE))
        elif way == 6:
            del parent[key]
        elif way == 7 and isinstance(parent, dict):
            parent[rng.choice(("", "x", 1, f"{key}_", "name"))] = parent.pop(key)
        elif way == 8:
            other, place = rng.choice(places)
            if place in range(len(other)) if isinstance(other, list) else place in other:
                parent[key] = copy.deepcopy(other[place])
        elif isinstance(parent, list):
            parent += copy.deepcopy(parent) * rng.choice((1, 1, 30))
    return tree


def _places(tree: Any) -> Any:
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield tree, key
        yield from _places(value)


def _near(value: Any, rng: random.Random) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float) and abs(value) < 1e300:
        return rng.choice((-value, value * 1e6, value + 1, value * 1e-6, str(value), [value], 0))
    if isinstance(value, str):
        return rng.choice((value + "x", value.upper(), value * 100, value[:1], [value], value + "\n"))
    return rng.choice((None, [value], str(value)[:200]))


def altered_yaml(sound: bytes, rng: random.Random) -> bytes:
    """Alter a document: its values, its text, or all of it."""
    return _document(sound, rng, yaml.safe_load, lambda tree: yaml.safe_dump(tree, allow_unicode=True))


def altered_json(sound: bytes, rng: random.Random) -> bytes:
    """The same of JSON."""
    return _document(sound, rng, json.loads, json.dumps)


def _document(sound: bytes, rng: random.Random, load: Callable[[bytes], Any], dump: Callable[[Any], str]) -> bytes:
    way = rng.random()
    if way < 0.04:
        return rng.choice(TEXTS)
    if way < 0.25:
        return altered_bytes(sound, rng)
    try:
        return dump(altered_tree(load(sound), rng)).encode("utf-8", "surrogatepass")
    except (ValueError, TypeError, yaml.YAMLError):
        return altered_bytes(sound, rng)


_VALUE = re.compile(rb'"([^"<>]*)"')
_ELEMENT = re.compile(rb"<[a-z_]+[^<>]*/>")


def altered_xml(sound: bytes, rng: random.Random) -> bytes:
    """Alter a document of XML: values of attributes, elements, its text, or all of it."""
    way = rng.random()
    if way < 0.03:
        return rng.choice(TEXTS)
    if way < 0.2:
        return altered_bytes(sound, rng)
    out = sound
    for _ in range(rng.choice((1, 1, 2, 4))):
        found = list((_VALUE if rng.random() < 0.7 else _ELEMENT).finditer(out))
        if not found:
            break
        one = rng.choice(found)
        if one.re is _VALUE:
            value = one.group(1).decode(errors="replace")
            fresh = rng.choice(("", "nan", "inf", "-1", "0 0 0", "1e999", "x", "0", "1e9", value + " 1", value[:-1]))
            if rng.random() < 0.3:
                fresh = rng.choice(found).group(1).decode(errors="replace")
            out = out[: one.start(1)] + fresh.encode() + out[one.end(1) :]
        else:
            out = out[: one.start()] + rng.choice((b"", one.group() * 2, one.group() * 50)) + out[one.end() :]
    return out


def altered_archive(sound: bytes, rng: random.Random) -> bytes:
    """Alter an archive of arrays (.npz): its members, the JSON in its head, or its bytes."""
    if rng.random() < 0.3:
        return altered_bytes(sound, rng)
    with np.load(io.BytesIO(sound)) as data:
        arrays: dict[str, Any] = {name: data[name] for name in data.files}
    name = rng.choice(list(arrays))
    way = rng.randrange(7)
    if way <= 2:
        text = altered_json(bytes(arrays["head"]), rng)
        arrays["head"] = np.frombuffer(text, np.uint8)
    elif way == 3:
        del arrays[name]
    elif way == 4:
        one = arrays[name]
        arrays[name] = rng.choice((
            np.full_like(one, rng.choice((0, 1, 255)) if one.dtype.kind in "ui" else np.nan), one.reshape(-1)[:-1],
            one[None], one.astype(np.complex128), one.astype("U8"), np.array(0.0), np.zeros((0, 3)),
            np.zeros(1, "M8[s]"), one.astype(">f8"),
        ))  # fmt: skip
    elif way == 5:
        arrays[name] = np.broadcast_to(np.zeros(1), (rng.choice((10**6, 9 * 10**6)),))
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    whole = out.getvalue()
    return _inner(whole, rng) if way == 6 else whole


def _inner(archive: bytes, rng: random.Random) -> bytes:
    """Alter the bytes of one member: its header of numpy above all, which the checksum of the archive then covers."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as source, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as target:
        chosen = rng.choice(source.namelist())
        for name in source.namelist():
            data = source.read(name)
            target.writestr(name, altered_bytes(data[:128], rng) + data[128:] if name == chosen else data)
    return out.getvalue()
