"""Mistakes that are made in sound files: in bytes, in text, in trees of YAML and JSON, and in tables.

Every function takes the random numbers that decide, so that a seed makes the same mistake again.
"""

import json
import math
import re
import struct
from random import Random
from typing import Any

NUMBERS = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 1e300, 1e18, -1e18, 1e9, -1e9, 1e6, 1e5, 1e-300, 5e-324, 0.0, -0.0,
    -1.0, 0.1, 2.0, 1e-9, 1e16, 255, 256, 32767, 65535, 2**31, 2**32, 2**53 + 1, 2**63, 2**64, 10**30, -(2**63),
)  # fmt: skip
TEXTS = (
    "", " ", "nan", "inf", "1e999", "\x1b[2J\x1b[31m", "\x00", "a\nb", "a\r\nb", "\ud800", "\U0001f600", "\u202e",
    "\ufeff", "x" * 5000, "..", "/", "/etc/passwd", "../../safety.yaml", "-1", "true", "null", "{}", "[]", "%s%n",
    "\u2028", "١٢٣", "1_000", "0x1F", "1,5", "12:30:45", "2026-01-01", "é" * 300,
)  # fmt: skip
SIGNS = (
    "[", "]", "{", "}", ":", "- ", "&a ", "*a", "!!python/name:os.system ", "!!binary ", "<<: ", "? ", "---\n", "...\n",
    "\t", "#", '"', "'", "|", ">", "@", "`", ",", ";", "\\ud800", "\\u0000",
)  # fmt: skip
WORDS = (
    *(word.encode("utf-8", "surrogatepass") for word in (*map(repr, NUMBERS), *TEXTS, *SIGNS)),
    b"\xff", b"\xff\xfe", b"\xfe\xff", b"\xc3", b"\xed\xa0\x80", b"\xf4\x90\x80\x80",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(\.\d*)?([eE][-+]?\d+)?")
_CODECS = ("utf-16", "utf-16-be", "utf-32", "latin-1", "utf-8-sig", "cp037")


def any_value(chance: Random, depth: int = 0) -> Any:
    """Return a number, a text, or a list or mapping of such."""
    kind = chance.randrange(8 if depth < 3 else 6)
    if kind < 3:
        return chance.choice(NUMBERS)
    if kind == 3:
        return chance.choice(TEXTS)
    if kind == 4:
        return chance.choice((True, False, None))
    if kind == 5:
        return chance.choice(([], {}, [[]], {"": {}}))
    if kind == 6:
        return [any_value(chance, depth + 1) for _ in range(chance.choice((1, 2, 3, 4, 12)))]
    return {chance.choice(TEXTS[:20]): any_value(chance, depth + 1) for _ in range(chance.randint(1, 3))}


# Bytes


def spoil_bytes(content: bytes, chance: Random) -> bytes:
    """Return the content with one to four mistakes in its bytes."""
    for _ in range(chance.choice((1, 1, 2, 4))):
        content = chance.choice(_IN_BYTES)(content, chance)
    return content


def _flip(content: bytes, chance: Random) -> bytes:
    spoiled = bytearray(content)
    for _ in range(chance.choice((1, 1, 3, 20)) if spoiled else 0):
        spoiled[chance.randrange(len(spoiled))] ^= 1 << chance.randrange(8)
    return bytes(spoiled)


def _cut(content: bytes, chance: Random) -> bytes:
    place = chance.randint(0, len(content))
    return chance.choice((content[:place], content[place:], content[: max(0, len(content) - chance.randint(1, 9))]))


def _splice(content: bytes, chance: Random) -> bytes:
    begin, end = _span(content, chance)
    other, after = _span(content, chance)
    return content[:begin] + chance.choice((b"", content[other:after], chance.randbytes(end - begin))) + content[end:]


def _repeat(content: bytes, chance: Random) -> bytes:
    begin, end = _span(content, chance)
    return content[:end] + content[begin:end] * chance.choice((1, 20, 500)) + content[end:]


def _poke(content: bytes, chance: Random) -> bytes:
    """Overwrite two, four or eight bytes by an absurd number."""
    layout = chance.choice(["<H", ">H", "<I", ">I", "<q", "<f", "<d", ">d"])
    place = chance.randint(0, len(content))
    if layout[1] in "fd":
        value: float = chance.choice((math.nan, math.inf, -1e18, 1e30, 1e-30, 0.0))
    else:
        value = (
            chance.choice((0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF))
            & (1 << 8 * struct.calcsize(layout)) - 1
        )
    number = struct.pack(layout, value)
    return content[:place] + number + content[place + len(number) :]


def _word(content: bytes, chance: Random) -> bytes:
    place = chance.randint(0, len(content))
    return content[:place] + chance.choice(WORDS) + content[place:]


def _number(content: bytes, chance: Random) -> bytes:
    numbers = list(_NUMBER.finditer(content))
    if not numbers:
        return _word(content, chance)
    number = chance.choice(numbers)
    return content[: number.start()] + chance.choice(WORDS) + content[number.end() :]


def _span(content: bytes, chance: Random) -> tuple[int, int]:
    begin = chance.randint(0, len(content))
    return begin, min(len(content), begin + chance.choice((0, 1, 4, 8, 64, 500)))


_IN_BYTES = (_flip, _cut, _splice, _repeat, _poke, _word, _number, _number)


# Text


def spoil_text(content: bytes, chance: Random) -> bytes:
    """Return lines of text with mistakes in rows, cells, their separators, or the encoding of the whole."""
    for _ in range(chance.choice((1, 1, 2, 4))):
        content = chance.choice(_IN_TEXT)(content, chance)
    return content


def _rows(content: bytes, chance: Random) -> bytes:
    lines = content.split(b"\n")
    row = chance.randrange(len(lines))
    kind = chance.randrange(5)
    if kind == 0:
        del lines[row : row + chance.choice((1, 1, 5))]
    elif kind == 1:
        lines[row:row] = [lines[row]] * chance.choice((1, 2, 3000))
    elif kind == 2:
        chance.shuffle(lines)
    elif kind == 3:
        lines.insert(row, chance.choice(WORDS))
    else:
        lines[row:] = reversed(lines[row:])
    return b"\n".join(lines)


def _cells(content: bytes, chance: Random) -> bytes:
    """Change one cell, or a whole column."""
    lines = content.split(b"\n")
    row = chance.randrange(len(lines))
    rows = range(row, len(lines)) if chance.random() < 0.3 else (row,)
    column, kind, word = chance.randrange(12), chance.randrange(4), chance.choice(WORDS)
    for number in rows:
        cells = lines[number].split(b",")
        if column >= len(cells):
            continue
        if kind == 0:
            cells[column] = word
        elif kind == 1:
            del cells[column]
        elif kind == 2:
            cells[column : column + 1] = [cells[column]] * 2
        else:
            cells[column] = b'"' + cells[column]
        lines[number] = b",".join(cells)
    return b"\n".join(lines)


def _separators(content: bytes, chance: Random) -> bytes:
    one, other = chance.choice(
        (
            (b"\n", b"\r"), (b"\n", b"\r\n"), (b"\n", b"\n\n"), (b"\n", b""), (b",", b";"), (b",", b"\t"), (b",", b" "),
            (b",", b""), (b".", b","), (b"\n", "\u2028".encode()), (b"-", "−".encode()), (b"0", b"\0"), (b":", b"="),
            (b"  ", b"\t"), (b":", b""), (b"\n", b",\n"), (b"e", b"E+"), (b",", b",,"),
        )
    )  # fmt: skip
    return content.replace(one, other, chance.choice((1, 3, -1)))


def _encoded(content: bytes, chance: Random) -> bytes:
    return content.decode("utf-8", "replace").encode(chance.choice(_CODECS), "replace")


def _long_line(content: bytes, chance: Random) -> bytes:
    place = chance.randint(0, len(content))
    return (
        content[:place]
        + chance.choice((b"1", b",", b"[", b" ", b"{a: ", b'"', b"9.")) * chance.choice((30, 2000, 200_000))
        + content[place:]
    )


_IN_TEXT = (_rows, _cells, _cells, _cells, _separators, _encoded, _long_line, _number, _number, _word, _cut, _splice)


# Trees


def spoil_tree(tree: Any, chance: Random) -> Any:
    """Return a tree of mappings and lists with one to three mistakes in it; the tree given is not changed."""
    tree = json.loads(json.dumps(tree))
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        holders = list(_holders(tree))
        if not holders:
            return any_value(chance)
        holder, key = chance.choice(holders)
        _spoil_at(holder, key, chance)
    return tree


def _holders(tree: Any):
    """Yield (mapping or list, key or index) of every value, but of long lists only a few."""
    entries: Any = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for number, (key, value) in enumerate(entries):
        if number < 6 or isinstance(tree, dict) or number == len(tree) - 1:
            yield tree, key
            yield from _holders(value)


def _spoil_at(holder: Any, key: Any, chance: Random) -> None:
    value, kind = holder[key], chance.randrange(13)
    if kind < 3:
        holder[key] = chance.choice(NUMBERS)
    elif kind == 3:
        holder[key] = any_value(chance)
    elif kind == 4:
        holder[key] = chance.choice(TEXTS)
    elif kind == 5 and isinstance(holder, dict):
        del holder[key]
    elif kind == 6 and isinstance(holder, dict):
        holder[chance.choice((*TEXTS[:20], *map(str, holder)))] = holder.pop(key)
    elif kind == 7:
        holder[key] = [value] * chance.choice((0, 1, 2, 7, 2000))
    elif kind == 8:
        for _ in range(chance.choice((1, 15, 30, 250))):
            value = chance.choice(([value], {"a": value}))
        holder[key] = value
    elif isinstance(value, int | float) and not isinstance(value, bool):
        scaled = [value * factor for factor in (-1, 0, 1e-6, 1e-3, 0.1, 0.5, 0.9, 1.1, 2, 10, 1e3, 1e6)]
        holder[key] = chance.choice((*scaled, str(value), [value], {"value": value}, bool(value)))
    elif isinstance(value, list) and value:
        holder[key] = chance.choice((value[:-1], value[1:], value + value[:1], value * 50, value[::-1], value[0]))
    else:
        holder[key] = chance.choice(([value], str(value), None))


def json_of(tree: Any, chance: Random) -> bytes:
    """Return a tree as JSON, as lax as Python writes it, sometimes with a key twice, and sometimes spoiled as text."""
    text = json.dumps(tree, ensure_ascii=chance.random() < 0.7).encode("utf-8", "surrogatepass")
    if chance.random() < 0.05 and text.startswith(b"{"):
        text = text[:-1] + b"," + text[1:]
    return spoil_bytes(text, chance) if chance.random() < 0.1 else text


def yaml_of(tree: Any, chance: Random) -> bytes:
    """Return a tree as YAML: JSON is YAML, with quoted keys and YAML's words for what is not finite."""
    text = json_of(tree, chance)
    for word, own in ((b"NaN", b".nan"), (b"-Infinity", b"-.inf"), (b"Infinity", b".inf")):
        text = text.replace(word, own)
    return text
