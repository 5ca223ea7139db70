"""Mutations of valid input: mistakes in bytes, text, trees of values, columns and packets.

Each function takes a random generator, `chance`, which hypothesis provides.
"""

import json
import math
import re
import struct
from collections.abc import Iterator
from random import Random
from typing import Any

import pyarrow as pa
import yaml

NUMBERS = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 1e300, 1e18, -1e18, 1e9, -1e9, 1e6, 1e5, 1e-300, 5e-324, 0.0, -0.0,
    -1.0, 0.1, 2.0, 1e-9, 1e16, 255, 256, 32767, 65535, 2**31, 2**32, 2**53 + 1, 2**63, 2**64, 10**30, -(2**63),
)  # fmt: skip
FLOATS = [float(number) for number in NUMBERS]
TEXTS = (
    "", " ", "nan", "inf", "1e999", "\x1b[2J\x1b[31m", "\x00", "a\nb", "a\r\nb", "\ud800", "\U0001f600", "\u202e",
    "\ufeff", "x" * 5000, "..", "/", "/etc/passwd", "../../safety.yaml", "-1", "true", "null", "{}", "[]", "%s%n",
    "\u2028", "١٢٣", "1_000", "0x1F", "1,5", "12:30:45", "2026-01-01", "é" * 300,
)  # fmt: skip
_SIGNS = (
    "[", "]", "{", "}", ":", "- ", "&a ", "*a", "!!python/name:os.system ", "!!binary ", "<<: ", "? ", "---\n", "...\n",
    "\t", "#", '"', "'", "|", ">", "@", "`", ",", ";", "\\ud800", "\\u0000",
)  # fmt: skip
_WORDS = (
    *(word.encode("utf-8", "surrogatepass") for word in (*map(repr, NUMBERS), *TEXTS, *_SIGNS)),
    b"\xff", b"\xff\xfe", b"\xfe\xff", b"\xc3", b"\xed\xa0\x80", b"\xf4\x90\x80\x80",
)  # fmt: skip
_SEPARATORS = (
    (b"\n", b"\r"), (b"\n", b"\r\n"), (b"\n", b"\n\n"), (b"\n", b""), (b",", b";"), (b",", b"\t"), (b",", b" "),
    (b",", b""), (b".", b","), (b"\n", "\u2028".encode()), (b"-", "−".encode()), (b"0", b"\0"), (b":", b"="),
    (b"  ", b"\t"), (b":", b""), (b"\n", b",\n"), (b"e", b"E+"), (b",", b",,"),
)  # fmt: skip
_CODECS = ("utf-16", "utf-16-be", "utf-32", "latin-1", "utf-8-sig", "cp037")
_NUMBER = re.compile(rb"-?\d+(\.\d*)?([eE][-+]?\d+)?")


# Bytes


def spoil_bytes(content: bytes, chance: Random) -> bytes:
    """Return the content with one to four mistakes in its bytes."""
    for _ in range(chance.choice((1, 1, 2, 4))):
        begin = chance.randint(0, len(content))
        end = min(len(content), begin + chance.choice((0, 1, 4, 8, 64, 500)))
        if chance.randrange(4) == 0:
            content = content[:begin]
        elif numbers := chance.randrange(3) == 0 and list(_NUMBER.finditer(content)):
            number = chance.choice(numbers)
            content = content[: number.start()] + chance.choice(_WORDS) + content[number.end() :]
        else:
            content = content[:begin] + _other_bytes(content, begin, end, chance) + content[end:]
    return content


def _other_bytes(content: bytes, begin: int, end: int, chance: Random) -> bytes:
    """Return the replacement for the bytes from `begin` to `end`."""
    part, kind = content[begin:end], chance.randrange(7)
    if kind == 0:
        return bytes(byte ^ 1 << chance.randrange(8) for byte in part[:20]) + part[20:]
    if kind == 1:
        return chance.choice((b"", part[::-1]))
    if kind == 2:
        return chance.randbytes(len(part))
    if kind == 3:
        other = chance.randint(0, len(content))
        return content[other : other + len(part)]
    if kind == 4:
        return part * chance.choice((2, 20, 500))
    if kind == 5:
        layout = chance.choice(("<f", "<d", ">d"))
        return struct.pack(layout, chance.choice((math.nan, math.inf, -1e18, 1e30, 1e-30, 0.0)))
    size = chance.choice((2, 4, 8))
    return chance.choice((0, 1, 0x7F, 2 ** (8 * size - 1), 2 ** (8 * size) - 1)).to_bytes(size, "little")


# Text


def spoil_text(content: bytes, chance: Random) -> bytes:
    """Return lines of text with mistakes in rows, cells, their separators, or the encoding."""
    for _ in range(chance.choice((1, 1, 2, 4))):
        kind = chance.randrange(8)
        if kind == 0:
            content = _spoil_rows(content, chance)
        elif kind < 4:
            content = _spoil_cells(content, chance)
        elif kind == 4:
            content = content.replace(*chance.choice(_SEPARATORS), chance.choice((1, 3, -1)))
        elif kind == 5:
            content = content.decode("utf-8", "replace").encode(chance.choice(_CODECS), "replace")
        elif kind == 6:
            place, mark = chance.randint(0, len(content)), chance.choice((b"1", b",", b"[", b" ", b"{a: ", b'"', b"9."))
            content = content[:place] + mark * chance.choice((30, 2000, 200_000)) + content[place:]
        else:
            content = spoil_bytes(content, chance)
    return content


def _spoil_rows(content: bytes, chance: Random) -> bytes:
    lines = content.split(b"\n")
    row, kind = chance.randrange(len(lines)), chance.randrange(4)
    if kind == 0:
        del lines[row : row + chance.choice((1, 1, 5))]
    elif kind == 1:
        lines[row:row] = [lines[row]] * chance.choice((1, 2, 3000))
    elif kind == 2:
        lines.insert(row, chance.choice(_WORDS))
    else:
        lines[row:] = reversed(lines[row:])
    return b"\n".join(lines)


def _spoil_cells(content: bytes, chance: Random) -> bytes:
    """Change one cell, or all cells of its column from there on."""
    lines = content.split(b"\n")
    row, column, kind = chance.randrange(len(lines)), chance.randrange(12), chance.randrange(4)
    word = chance.choice(_WORDS)
    for number in range(row, len(lines)) if chance.randrange(3) == 0 else (row,):
        cells = lines[number].split(b",")
        if column < len(cells):
            old = cells[column]
            cells[column : column + 1] = ([word], [], [old, old], [b'"' + old])[kind]
            lines[number] = b",".join(cells)
    return b"\n".join(lines)


# Trees of values, as JSON and YAML


def spoil_tree(tree: Any, chance: Random) -> Any:
    """Return a copy of a tree of mappings and lists with one to three mistakes."""
    tree = json.loads(json.dumps(tree))
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        places = list(_places(tree))
        if not places:
            return _any_value(chance)
        _spoil_at(*chance.choice(places), chance)
    return tree


def json_of(tree: Any, chance: Random) -> bytes:
    """Return a tree as Python's lax JSON, sometimes with damaged bytes."""
    text = json.dumps(tree, ensure_ascii=chance.random() < 0.7).encode("utf-8", "surrogatepass")
    return spoil_bytes(text, chance) if chance.randrange(10) == 0 else text


def spoil_yaml(content: bytes, chance: Random) -> bytes:
    """Return a YAML file with mistakes in its tree, its text or its bytes."""
    kind = chance.randrange(4)
    if kind >= 2:
        return (spoil_bytes if kind == 2 else spoil_text)(content, chance)
    text = json_of(spoil_tree(yaml.safe_load(content), chance), chance)  # JSON is YAML but for NaN and infinity
    for word, own in ((b"NaN", b".nan"), (b"-Infinity", b"-.inf"), (b"Infinity", b".inf")):
        text = text.replace(word, own)
    return text


def _any_value(chance: Random, depth: int = 0) -> Any:
    kind = chance.randrange(7 if depth < 3 else 5)
    if kind < 2:
        return chance.choice(NUMBERS)
    if kind < 5:
        return chance.choice((TEXTS, (True, False, None), ([], {}, [[]], {"": {}}))[kind - 2])
    if kind == 5:
        return [_any_value(chance, depth + 1) for _ in range(chance.choice((1, 2, 3, 4, 12)))]
    return {chance.choice(TEXTS[:20]): _any_value(chance, depth + 1) for _ in range(chance.randint(1, 3))}


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (mapping or list, key or index) of every value; of long lists only a few."""
    entries: Any = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for number, (key, value) in enumerate(entries):
        if number < 6 or isinstance(tree, dict) or number == len(tree) - 1:
            yield tree, key
            yield from _places(value)


def _spoil_at(holder: Any, key: Any, chance: Random) -> None:
    value, kind = holder[key], chance.randrange(12)
    if kind < 4:
        holder[key] = (chance.choice(NUMBERS), chance.choice(NUMBERS), _any_value(chance), chance.choice(TEXTS))[kind]
    elif kind == 4 and isinstance(holder, dict):
        del holder[key]
    elif kind == 5 and isinstance(holder, dict):
        holder[chance.choice((*TEXTS[:20], *map(str, holder)))] = holder.pop(key)
    elif kind == 6:
        holder[key] = [value] * chance.choice((0, 1, 2, 7, 2000))
    elif kind == 7:
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


# Columns


def spoil_columns(table: pa.Table, chance: Random) -> pa.Table:
    """Return a table in which one column is absurd, of another type, missing, duplicated or renamed, or rows differ."""
    number, kind = chance.randrange(table.num_columns), chance.randrange(8)
    name, values = table.column_names[number], table.column(number)
    if kind == 0:
        return table.remove_column(number)
    if kind == 1:
        return table.append_column(name, values)
    if kind == 2:
        return table.slice(0, chance.choice((0, 1, 2)))
    if kind == 3:
        return pa.concat_tables([table] * chance.choice((2, 50)))
    if kind == 4:
        return table.rename_columns(["\ufffd" if other == name else other for other in table.column_names])
    if kind == 5:
        return table.set_column(number, name, chance.choice((pa.array(["x"] * len(values)), pa.nulls(len(values)))))
    changed = values.to_pylist()
    for row in range(len(changed)) if chance.randrange(2) else range(min(1, len(changed))):
        changed[row] = _other_entry(changed[row], chance)
    try:
        return table.set_column(number, name, pa.array(changed, type=values.type))
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):  # the column cannot hold the entry
        return table.set_column(number, name, pa.nulls(len(values), values.type))


def _other_entry(old: Any, chance: Random) -> Any:
    absurd = chance.choice((None, math.nan, math.inf, 1e308, -1.0, 0.0, 2**40))
    if isinstance(old, list) and old:
        place = chance.randrange(len(old))
        return chance.choice((old[:place], old * 2, [*old[:place], absurd, *old[place + 1 :]], []))
    return chance.choice((None, "", "x" * 5000, "\x1b[2J")) if isinstance(old, str) else absurd


# Packets


def spoil_packets(packets: list[bytes], chance: Random) -> list[bytes]:
    """Return a stream with packets damaged, repeated, or lost."""
    packets = list(packets)
    for _ in range(chance.choice((1, 2, 4))):
        number = chance.randrange(len(packets))
        packets[number : number + 1] = chance.choice(
            ([spoil_bytes(packets[number], chance)], [packets[number]] * chance.choice((2, 100)), [])
        )
        if not packets:
            break
    return packets
