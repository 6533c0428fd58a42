"""Changes of JSON and of tables."""

from __future__ import annotations

import json
import re
from random import Random
from typing import Any

from tests.fuzz.changes.plain import change_bytes

NAMES = ("../../etc/passwd", "/etc/passwd", "C:\\x", "..", "a\nb", "\x1b[31mred", "\0", "x" * 5000, "\udcff", "é" * 300)
WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "9" * 400, "1_000", "٣", "0x10", "1,5", "", "#", '"', "x" * 9000, "\0"),
)
_RAW = (  # JSON text
    *("null", "true", "-1", "0", "1e308", "-1e400", "9" * 400, "-" + "9" * 400, "0." + "3" * 400, "NaN", "Infinity"),
    *("1e-400", "[]", "{}", '""', "[[]]", '{"": {"": null}}', "18446744073709551616", "0.5", "[1, 2, 3, 4, 5]"),
    *("[" * 70 + "]" * 70, "[" * 9000 + "]" * 9000, '{"a":' * 9000 + "1" + "}" * 9000, '"\\ud800"', '"\\u0000"'),
    *("[" + "0," * 20_000 + "0]", "[" + '"x",' * 20_000 + '"x"]', '{"a": 1, "a": 2}', '"' + "y" * 100_000 + '"'),
    *(json.dumps(name) for name in NAMES),
)


def change_json(content: bytes, random: Random) -> bytes:
    try:
        value = json.loads(content)
    except (ValueError, RecursionError):
        return change_bytes(content, random)
    return mutated_json(value, random).encode("utf-8", "surrogatepass")


def mutated_json(value: Any, random: Random) -> str:
    """Return the text of a value with one node changed: replaced, left out, doubled, renamed or wrapped."""
    value = {"": value}
    places = [(parent, parent if isinstance(parent, dict) else range(len(parent))) for parent in _containers(value)]
    nodes = [(parent, key) for parent, keys in places for key in keys]
    parent, key = random.choice(nodes)
    raw = random.choice(_RAW)
    choice = random.randrange(8)
    if choice == 0 and len(nodes) > 1 and parent is not value:
        del parent[key]
    elif choice == 1 and isinstance(parent, dict):
        parent[random.choice((*NAMES, "", "constructor", "x"))] = parent[key]
    elif choice == 2:
        parent[key] = [parent[key]]
    elif choice == 3 and isinstance(parent[key], list):
        parent[key] = parent[key] * random.choice((0, 2, 300))
    elif choice == 4:
        other, place = random.choice(nodes)
        if other is not value and parent is not value:
            parent[key], other[place] = json.loads(json.dumps(other[place])), json.loads(json.dumps(parent[key]))
    elif choice == 5 and isinstance(parent, dict) and key:
        parent[key] = "@double@"
        text = json.dumps(value[""])
        return text.replace('"@double@"', f"{raw}, {json.dumps(key)}: {raw}", 1)
    else:
        parent[key] = "@raw@"
        return json.dumps(value[""]).replace('"@raw@"', raw, 1)
    return json.dumps(value[""])


def _containers(value: Any) -> list[Any]:
    found, todo = [], [value]
    while todo:
        if isinstance(container := todo.pop(), dict | list):
            found.append(container)
            todo += container.values() if isinstance(container, dict) else container
    return found


def change_text(content: bytes, random: Random) -> bytes:
    """Change lines or cells of a table, or a line of JSON values."""
    try:
        lines = content.decode().splitlines()
    except UnicodeDecodeError:
        return change_bytes(content, random)
    if not lines:
        return random.choice(WORDS).encode()
    number = random.randrange(len(lines))
    line = lines[number]
    if line.startswith("{") and random.random() < 0.7:
        lines[number] = change_json(line.encode(), random).decode("utf-8", "surrogatepass")
        return "\n".join(lines).encode("utf-8", "surrogatepass")
    words = re.split(r"([,;\s]+)", line)
    place = random.randrange(len(words))
    change = random.randrange(10)
    if change < 4:
        words[place] = random.choice((*WORDS, *NAMES))
        lines[number] = "".join(words)
    elif change == 4:
        del lines[number]
    elif change == 5:
        lines[number] = "".join(words[:place])
    elif change == 6:
        lines[number] = line + random.choice((" ", ",")) + random.choice(WORDS) * random.choice((1, 1, 1000))
    elif change == 7:
        lines[number:number] = [line] * random.choice((1, 2000))
    elif change == 8:
        lines[number] = random.choice(("\ufeff", "# ", '"', "\r", "\u2028", "\x85")) + line
    else:
        lines = [line.replace(" ", random.choice((",", "\t", "  "))) for line in lines]
    return random.choice(("\n", "\n", "\r\n", "\r")).join(lines).encode("utf-8", "surrogateescape")
