"""The documentation's Python runs: the blocks of a file, in order, as one script in an empty folder.

A fence opened with ```python is executed; ```python no-run is shown only.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from uavrl.cli import COMMANDS, parse
from uavrl.errors import ConfigError

ROOT = Path(__file__).parents[1]
DOCUMENTS = [path for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))) if path.exists()]
FENCE = re.compile(r"^(?P<indent> *)(?P<ticks>`{3,})(?P<info>.*)$")


def python_script(markdown: str) -> str:
    """Return the executed blocks as one script, each line on its line of the document, so that tracebacks point there.

    Raises:
        ValueError: a fence is not closed, or says something after `python` other than `no-run`.
    """
    script: list[str] = []
    opened: re.Match[str] | None = None
    block: list[str] = []
    for number, line in enumerate(markdown.splitlines(), start=1):
        fence = FENCE.match(line)
        script.append("")
        if opened is None:
            if fence is not None:
                opened, block = fence, []
                language, _, attribute = fence["info"].strip().partition(" ")
                if language == "python" and attribute.strip() not in ("", "no-run"):
                    raise ValueError(f"line {number}: ```python {attribute!r}, allowed is no-run")
        elif fence is not None and not fence["info"].strip() and len(fence["ticks"]) >= len(opened["ticks"]):
            if opened["info"].strip() == "python":
                script[-1 - len(block) : -1] = textwrap.dedent("\n".join(block)).split("\n") if block else []
            opened = None
        else:
            block.append(line)
    if opened is not None:
        raise ValueError(f"the fence {opened['ticks']}{opened['info']} is never closed")
    return "\n".join(script)


def run(script: str, name: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = folder / f"{name}.py"
    path.write_text(script)
    environment = os.environ | {"MINARI_DATASETS_PATH": str(folder / "minari"), "MPLBACKEND": "Agg"}
    command = [sys.executable, str(path)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_python_blocks_run(document: Path, tmp_path: Path) -> None:
    script = python_script(document.read_text())
    if not script.strip():
        return  # prose only
    result = run(script, f"document_{document.stem}", tmp_path)
    assert result.returncode == 0, f"{document.relative_to(ROOT)}, line numbers as in the document:\n{result.stderr}"


def test_the_words_of_every_command_shown_are_taken() -> None:
    """In a console and, where it has an option, within a sentence; what stands for a user's own name is any word."""
    shown = re.compile(r"^\$ uavrl (?P<console>.*?)(\s#.*)?$|`uavrl (?P<inline>[^`]* --[^`]*)`", re.MULTILINE)
    lines = 0
    for document in (*DOCUMENTS, *sorted((ROOT / "results").rglob("README.md"))):
        text = document.read_text().replace("\\\n", " ")
        for match in shown.finditer(text):
            typed = (match["console"] or match["inline"]).split(" > ")[0]
            if match["inline"] and re.search(r"\.\.\.|--\w+$", typed):
                continue  # shortened, or about the option itself
            words = shlex.split(typed.replace(" ... ", " "))
            where = f"{document.relative_to(ROOT)}: {match[0]}"
            names = [" ".join(words[:count]) for count in (1, 2) if " ".join(words[:count]) in COMMANDS]
            assert names, where
            try:
                parse(names[0], words[len(names[0].split()) :])
            except ConfigError as error:
                if match["console"] or "Unrecognized" in str(error):  # a sentence may leave words out
                    pytest.fail(f"{where}: {error}")
            lines += 1
    assert lines > 40


def test_blocks_share_one_namespace_and_keep_their_lines() -> None:
    script = python_script("# Title\n\n```python\na = 1\n```\ntext\n- item\n  ```python\n  if a:\n      b = a\n  ```\n")
    assert script.split("\n")[3] == "a = 1"
    assert script.split("\n")[8:10] == ["if a:", "    b = a"]


def test_other_blocks_are_left_out() -> None:
    text = "```python no-run\n1 / 0\n```\n```console\n$ uavrl demo\n```\n````text\n```python\n1 / 0\n```\n````\n"
    assert not python_script(text).strip()


def test_a_failing_block_is_reported_at_its_line(tmp_path: Path) -> None:
    result = run(python_script("text\n\n```python\n1 / 0\n```\n"), "bad", tmp_path)
    assert result.returncode != 0
    assert "line 4" in result.stderr


@pytest.mark.parametrize("text", ["```python norun\n```\n", "```python\na = 1\n"])
def test_a_malformed_fence_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"no-run|never closed"):
        python_script(text)
