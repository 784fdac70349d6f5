"""Mutants of the core, all in one build: each changed expression is `(mutant(17) ? changed : original)`, and the
variable INVARIODE_MUTANT says which one is changed. In some of the source files, so that few are compiled again."""

from __future__ import annotations

import random
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

VARIABLE = "INVARIODE_MUTANT"
FILES = 12
HEADER = f"""#pragma once
#include <cstdlib>
inline bool mutant(int number) {{
  static const int chosen = std::getenv("{VARIABLE}") ? std::atoi(std::getenv("{VARIABLE}")) : -1;
  return number == chosen;
}}
"""
ONE = r"[A-Za-z_][\w.]*(?:->\w+)*(?:\[[\w +.]*\]|\(\))*|\d+(?:\.\d+)?"
BEFORE, AFTER = r"(?:(?<=\()|(?<= = )|(?<=&& )|(?<=\|\| )|(?<=return ))", r"(?=[);,]| &&| \|\|| \?)"
OTHER = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "+": "-", "-": "+", "*": "/", "/": "*"}
OTHER |= {"&&": "||", "||": "&&"}

#: Pattern of what is changed in a line of a function, and what it becomes; {0} is the number of the mutant.
KINDS = {
    "operator": (
        rf"{BEFORE}({ONE}) ([<>=!]=|[<>+*/-]|&&|\|\|) ({ONE}){AFTER}",
        lambda m: f"(mutant({{0}}) ? {m[1]} {OTHER[m[2]]} {m[3]} : {m[1]} {m[2]} {m[3]})",
    ),
    "constant": (r"(?<![\w.])(\d+\.\d+)(?![\w.])", lambda m: f"(mutant({{0}}) ? {1.5 * float(m[1]) + 1} : {m[1]})"),
    "condition": (
        r"\bif \(([^;={}]+|[^;{}]*[=!<>]= [^;{}]*)\)(?= return| \w+|$| \{$)",
        lambda m: f"if (mutant({{0}}) != static_cast<bool>({m[1]}))",
    ),
    "deletion": (
        r"(?<=^  )( *)((?!return|throw|delete|break|continue)[\w.]+(?:->\w+)*(?:\[\w+\])?(?:\(.*\)| [-+*/]?= .*));$",
        lambda m: f"{m[1]}if (!mutant({{0}})) {m[2]};",
    ),
}


def sites(lines: list[str], kind: str) -> Iterator[int]:
    inside = False
    for number, line in enumerate(lines):
        inside = (inside or line.endswith("{")) and line[:1] != "}"
        begins = lines[number - 1].rstrip().endswith((";", "{", "}", ":"))
        ordinary = line.startswith("  ") and "constexpr" not in line and "//" not in line
        whole = line.count("(") == line.count(")") and (begins or kind != "deletion")
        if inside and ordinary and whole and re.search(KINDS[kind][0], line):
            yield number


def changed(line: str, kind: str, number: int) -> str:
    pattern, change = KINDS[kind]
    return re.sub(pattern, lambda m: change(m).replace("{0}", str(number)), line, count=1)


def candidates(core: Path, seed: int) -> list[tuple[str, int, str]]:
    """(file, line, kind) in the order in which they are chosen, at most one for each line."""
    chooser = random.Random(seed)
    files = [path for path in sorted(core.rglob("*.cpp")) if "lanes" not in path.parts]
    long = [path for path in files if len(path.read_text().splitlines()) > 120]
    found: dict[str, list[tuple[str, int, str]]] = {kind: [] for kind in KINDS}
    for path in sorted(chooser.sample(long, FILES)):
        lines = path.read_text().split("\n")
        for kind, of_kind in found.items():
            of_kind += [(str(path.relative_to(core)), number, kind) for number in sites(lines, kind)]
    for of_kind in found.values():
        chooser.shuffle(of_kind)
    longest = max(map(len, found.values()))
    turns = [of_kind[i] for i in range(longest) for of_kind in found.values() if i < len(of_kind)]
    return list({(file, line): (file, line, kind) for file, line, kind in reversed(turns)}.values())[::-1]


def write(root: Path, folder: Path, chosen: dict[int, tuple[str, int, str]]) -> None:
    """The source files with the chosen changes; what has not changed keeps its time, what is no longer there goes."""
    texts = {file: (root / "core" / file).read_text().split("\n") for file, _, _ in chosen.values()}
    for number, (file, line, kind) in chosen.items():
        texts[file][line] = changed(texts[file][line], kind, number)
    wanted = {folder / path.relative_to(root): path.read_text() for path in sources(root)}
    for file, lines in texts.items():
        to = folder / "core" / file
        wanted[to] = f'#include "mutant.hpp"\n#line 1 "{to}"\n' + "\n".join(lines)
    wanted[folder / "core" / "mutant.hpp"] = HEADER
    for path in set(sources(folder)) - set(wanted):
        path.unlink()
    for path, text in wanted.items():
        if not path.exists() or path.read_text() != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


def sources(root: Path) -> list[Path]:
    folders = (root / name for name in ("core", "binding"))
    return [*(path for folder in folders for path in folder.rglob("*.?pp")), root / "CMakeLists.txt"]


def build(root: Path, folder: Path, count: int, seed: int) -> list[str]:
    """Builds the extension with `count` mutants in folder/build/dev, and tells which; the next ones replace those
    that do not compile."""
    waiting = candidates(root / "core", seed)
    chosen = {number: waiting.pop(0) for number in range(count)}
    write(root, folder, chosen)
    place = folder / "build" / "dev"
    if not (place / "build.ninja").exists():
        nanobind = subprocess.check_output([sys.executable, "-m", "nanobind", "--cmake_dir"], text=True).strip()
        subprocess.check_call(
            ["cmake", "-G", "Ninja", "-S", folder, "-B", place, f"-Dnanobind_DIR={nanobind}",
             f"-DPython_EXECUTABLE={sys.executable}", "-DINVARIODE_UNITY=OFF"]
        )  # fmt: skip
    while True:
        done = subprocess.run(["ninja", "-C", place, "-k", "0"], capture_output=True, text=True)
        wrong = set(re.findall(r"core/([\w/]+\.cpp):(\d+):\d+: error", done.stdout))
        if done.returncode == 0:
            return [f"{file}:{line + 1} {kind}" for file, line, kind in chosen.values()]
        failed = [number for number, (file, line, _) in chosen.items() if (file, str(line + 1)) in wrong]
        if not failed:
            raise RuntimeError(done.stdout[-4000:])
        for number in failed:
            chosen[number] = waiting.pop(0)
        write(root, folder, chosen)
