"""`uavrl scenario show | diff | check`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import BaseModel

from uavrl.errors import ScenarioError
from uavrl.scenario import Scenario, load_scenario, scenario_diff


@dataclass(frozen=True)
class ScenarioShow:
    """Print a scenario as TOML, each field with its description, unit and range; save it, change it, fly it."""

    scenario: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENARIO")] = "released"
    """a preset (paper, released, realistic) or a TOML file"""

    def run(self) -> None:
        print(annotated_toml(load_scenario(self.scenario)), end="")


@dataclass(frozen=True)
class ScenarioDiff:
    """List the fields in which two scenarios differ."""

    first: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FIRST")]
    """a preset or a TOML file"""
    second: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SECOND")]
    """a preset or a TOML file"""

    def run(self) -> None:
        first, second = load_scenario(self.first), load_scenario(self.second)
        differences = scenario_diff(first, second)
        if not differences:
            print(f"{self.first} and {self.second} are equal")
            return
        width = max(len(key) for key in differences)
        for key, (left, right) in differences.items():
            print(f"{key:<{width}}  {_value(left)} -> {_value(right)}")


@dataclass(frozen=True)
class ScenarioCheck:
    """Validate a scenario file: says that it can be flown, or which field cannot be, and why."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """a TOML file"""

    def run(self) -> None:
        if self.file.suffix != ".toml":
            raise ScenarioError(f"scenario file '{self.file}' is no .toml file")
        scenario = load_scenario(self.file)
        changed = scenario_diff(load_scenario("released"), scenario)
        print(f"{self.file}: valid, {scenario.traffic.devices} devices, {len(changed)} fields differ from 'released'")


def annotated_toml(scenario: Scenario) -> str:
    """TOML that `load_scenario` reads back to an equal scenario, with a comment on every field."""
    lines = [f"name = {json.dumps(scenario.name)}"]
    for section, info in Scenario.model_fields.items():
        model = info.annotation
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            continue
        lines += ["", f"# {(model.__doc__ or '').strip().splitlines()[0]}", f"[{section}]"]
        values = getattr(scenario, section)
        for name, field in model.model_fields.items():
            schema = model.model_json_schema()["properties"][name]
            allowed = " or ".join(dict.fromkeys(_allowed(schema)))
            lines += [f"# {field.description}; {allowed}", f"{name} = {_value(getattr(values, name))}"]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """A leaf as TOML; the word "none" stands for a limit that is absent."""
    if value is None:
        return '"none"'
    return json.dumps(list(value) if isinstance(value, tuple) else value)


def _allowed(schema: dict[str, Any]) -> Iterator[str]:
    """What a JSON schema allows, in words: "> 0", "one of ..."."""
    if "anyOf" in schema:
        for branch in schema["anyOf"]:
            yield from _allowed(branch)
    elif "enum" in schema:
        yield "one of " + ", ".join(json.dumps(value) for value in schema["enum"])
    elif schema.get("type") == "null":
        yield '"none"'
    elif schema.get("type") == "boolean":
        yield "true or false"
    elif schema.get("type") == "array":
        items = " or ".join(_allowed(schema.get("items", schema.get("prefixItems", [{}])[0])))
        yield f"a list of {items}"
    else:
        signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
        bounds = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
        kind = "whole number" if schema.get("type") == "integer" else "number"
        yield f"{kind} {' and '.join(bounds)}".strip()
