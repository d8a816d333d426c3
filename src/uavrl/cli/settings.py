"""Pydantic configurations from what a user typed; `--set name=value` reaches any nested setting."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from pydantic import BaseModel, ValidationError

from uavrl.errors import ConfigError
from uavrl.scenario import describe_validation

Config = TypeVar("Config", bound=BaseModel)
Many = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]  # an option that is repeated for more


def with_settings(config: Config, settings: tuple[str, ...]) -> Config:
    """The configuration with `bc_weight=0.3`, `diffusion.steps=10` and the like applied.

    Raises:
        ConfigError: no `=`, no such setting, or a value that it does not allow.
    """
    data = config.model_dump()
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting!r}, allowed: name=value, such as bc_weight=0.3")
        *sections, leaf = name.split(".")
        place: Any = data
        for section in sections:
            place = place.get(section) if isinstance(place, dict) else None
        if not isinstance(place, dict) or leaf not in place or leaf == "name":
            known = ", ".join(key for key in (place if isinstance(place, dict) else data) if key != "name")
            raise ConfigError(f"setting '{name}' does not exist, allowed: {known}")
        place[leaf] = _value(text)
    return pydantic_config(type(config), **data)


def _value(text: str) -> Any:
    """JSON where it is JSON (numbers, true, null), else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def pydantic_config(kind: type[Config], /, **values: Any) -> Config:
    """A configuration from what a user typed.

    Raises:
        ConfigError: one line naming the setting, its value and what is allowed.
    """
    try:
        return kind(**values)
    except ValidationError as error:
        raise ConfigError(describe_validation(error, "setting")) from None


def differing(began: BaseModel, asked: BaseModel) -> str:
    """Each setting of `began` that is another one in `asked`, as `--set` names it."""
    return ", ".join(_differing(began.model_dump(mode="json"), asked.model_dump(mode="json")))


def _differing(began: dict[str, Any], asked: dict[str, Any], section: str = "") -> Iterator[str]:
    for name, value in began.items():
        other = asked.get(name)
        if isinstance(value, dict) and isinstance(other, dict):
            yield from _differing(value, other, f"{section}{name}.")
        elif other != value:
            yield f"{section.removeprefix('agent.')}{name}={json.dumps(value)}"


def output_directory(path: Path) -> None:
    """Make a run's directory now, rather than fail to after an hour.

    Raises:
        ConfigError: it is a file, or cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out '{path}' cannot be made, allowed: a directory ({error.strerror})") from None


def check_writable(path: Path) -> None:
    """Refuse now what could not be written after an hour's flights.

    Raises:
        ConfigError: `path` is a directory, or lies in one that does not exist or may not be written.
    """
    if path.is_dir():
        raise ConfigError(f"file '{path}' is a directory, allowed: a file to write")
    if not path.parent.is_dir():
        raise ConfigError(f"file '{path}': the directory '{path.parent}' does not exist, make it first")
    if not os.access(path.parent, os.W_OK):
        raise ConfigError(f"file '{path}' cannot be written: no permission in '{path.parent}'")
