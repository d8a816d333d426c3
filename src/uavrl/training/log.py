"""Run logs: one JSON object a line, TensorBoard beside it where asked for, and progress on the terminal."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavrl.errors import ConfigError


class MetricsLog:
    """Appends rows to a JSONL file; a number that is not finite is written as null.

    Args:
        path: of the file.
        board: folder for TensorBoard's event files; none are written without.

    Raises:
        ConfigError: `board` is given and TensorBoard is not installed.
    """

    def __init__(self, path: Path, board: Path | None = None) -> None:
        self.path, self.board = Path(path), board
        self.writer: Any = None
        if board is not None:
            require_tensorboard()
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def write(self, row: Mapping[str, Any]) -> None:
        """Append one row."""
        clean = {
            key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()
        }
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(clean) + "\n")
        if self.board is not None:
            step = int(row["step"])
            if self.writer is None:
                self.writer = require_tensorboard()(str(self.board), purge_step=step)
            for key, value in clean.items():
                if key != "step" and isinstance(value, int | float):
                    self.writer.add_scalar(key, value, step)

    def cut(self, step: int) -> None:
        """Drop rows after `step`: what a run wrote beyond the checkpoint that it resumes from."""
        if self.path.exists():
            kept = [row for row in read_metrics(self.path) if row.get("step", 0) <= step]
            aside = self.path.with_name(f".{self.path.name}.tmp")
            aside.write_text("".join(json.dumps(row) + "\n" for row in kept), encoding="utf-8")
            aside.replace(self.path)  # a process killed in between loses no row

    def close(self) -> None:
        """Write out what TensorBoard still holds back."""
        if self.writer is not None:
            self.writer.close()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a log, but for a line whose writer was killed within it."""
    rows = []
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


def require_tensorboard() -> Any:
    """Its writer's class.

    Raises:
        ConfigError: not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ConfigError(
            "tensorboard = true needs the extra 'tracking', which is not installed: pip install 'uavrl[tracking]'"
        ) from None
    return SummaryWriter


class Reporter(Protocol):
    """Called with the number of finished steps and a short text."""

    def __call__(self, done: int, text: str) -> None: ...


@contextmanager
def progress(title: str, total: int, unit: str, stream: TextIO | None = None) -> Iterator[Reporter]:
    """Progress with rate and time left on `stream` (stderr): a bar on a terminal, else a line every half minute."""
    stream = sys.stderr if stream is None else stream
    console = Console(file=stream)
    started = time.monotonic()
    first: int | None = None
    if console.is_terminal:
        rate = TextColumn("{task.fields[rate]}")
        columns = (
            TextColumn(title),
            BarColumn(),
            MofNCompleteColumn(),
            rate,
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, TextColumn("{task.fields[text]}"), console=console) as bar:
            task = bar.add_task(title, total=total, rate="", text="")

            def show(done: int, text: str) -> None:
                nonlocal first
                first = done if first is None else first
                rate = (done - first) / max(time.monotonic() - started, 1e-9)
                bar.update(task, completed=done, rate=f"{rate:,.0f} {unit}/s", text=text)

            yield show
        return
    last = started

    def tell(done: int, text: str) -> None:
        nonlocal last, first
        now = time.monotonic()
        first = done if first is None else first
        if now - last >= 30.0 or done >= total > first:
            last = now
            rate = (done - first) / max(now - started, 1e-9)
            left = f"{(total - done) / rate:,.0f} s left" if rate > 0 else "time left unknown"
            print(f"{title}: {done:,}/{total:,} {unit}, {rate:,.0f}/s, {left}  {text}", file=stream, flush=True)

    yield tell
