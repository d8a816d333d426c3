"""Data flows one way: a room of the package imports only from itself and from rooms above it."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "uavrl"

# From top to bottom. A new module or package of src/uavrl needs a place here.
ROOMS = (
    "errors",
    "scenario",
    "physics",
    "actions",
    "simulation",
    "policies",
    "diffusion",
    "networks",
    "agents",
    "datasets",
    "evaluation",
    "training",
    "deployment",
    "viewer",
    "benchmarks",
    "experiments",
    "cli",
    "__main__",
)

# Rooms above that are closed all the same: agents know nothing of UAVs.
CLOSED = {"agents": {"scenario", "physics", "simulation", "policies"}}

# Libraries that a room must not know: agents know nothing of files, command line or plots.
CLOSED_LIBRARIES = {"agents": {"h5py", "matplotlib", "minari", "pathlib", "plotly", "pyarrow", "rich", "tyro"}}

# Modules that may import only these libraries, beside the standard one, and nothing of uavrl: what flies is small.
ALONE = {"uavrl.deployment.runtime": {"numpy", "onnxruntime"}}


def module_name(path: Path) -> str:
    parts = ("uavrl", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(source: str, module: str, *, is_package: bool = False) -> Iterator[tuple[int, str]]:
    """Yield (line, absolute name) of each import, those inside functions and under TYPE_CHECKING included.

    `from a import b` yields `a.b`, for b may be a module.
    """
    package = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{stem}.{alias.name}") for alias in node.names)


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """Return what `module` imports against the rules, one line each."""
    room = module.split(".")[1] if "." in module else "__init__"
    found = []
    for line, name in imports(source, module, is_package=is_package):
        top, _, rest = name.partition(".")
        where = f"{module}:{line} imports {name}"
        if top == "uavrl":
            other = rest.split(".")[0]
            if module in ALONE:
                found.append(f"{where}: this module stands alone")
            elif other == "__version__" or other == room:
                continue
            elif room == "__init__":
                found.append(f"{where}: uavrl/__init__.py holds the version only")
            elif other not in ROOMS:
                found.append(f"{where}: {other!r} is not a room")
            elif ROOMS.index(other) > ROOMS.index(room):
                found.append(f"{where}: {other} is below {room}")
            elif other in CLOSED.get(room, set()):
                found.append(f"{where}: {other} is closed to {room}")
        elif top in CLOSED_LIBRARIES.get(room, set()):
            found.append(f"{where}: {room} must not know {top}")
        elif module in ALONE and top not in ALONE[module] | sys.stdlib_module_names:
            found.append(f"{where}: only {', '.join(sorted(ALONE[module]))} may be imported here")
    return found


MODULES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_module_imports_only_from_rooms_above(path: Path) -> None:
    assert violations(path.read_text(), module_name(path), is_package=path.name == "__init__.py") == []


def test_every_module_and_package_has_its_place() -> None:
    rooms = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in MODULES} - {"__init__"}
    unplaced = rooms - set(ROOMS)
    assert not unplaced, f"place {sorted(unplaced)} in ROOMS, between what they import and what imports them"


@pytest.mark.parametrize(
    ("module", "source", "reason"),
    [
        ("uavrl.physics.age", "import uavrl.agents.sac", "agents is below physics"),
        ("uavrl.physics.age", "from uavrl import agents", "agents is below physics"),
        ("uavrl.physics.age", "from ..agents import sac", "agents is below physics"),
        ("uavrl.simulation.state", "def f():\n    from uavrl.networks import mlp", "networks is below simulation"),
        ("uavrl.policies.tdm", "if TYPE_CHECKING:\n    import uavrl.diffusion", "diffusion is below policies"),
        ("uavrl.scenario", "from .physics import age", "physics is below scenario"),
        ("uavrl.agents.sac", "from uavrl.scenario import Scenario", "scenario is closed to agents"),
        ("uavrl.agents.sac", "import uavrl.policies as p", "policies is closed to agents"),
        ("uavrl.agents.sac", "from matplotlib import pyplot", "agents must not know matplotlib"),
        ("uavrl.training.online", "from uavrl.helpers import f", "'helpers' is not a room"),
        ("uavrl.deployment.runtime", "import torch", "only numpy, onnxruntime may be imported here"),
        ("uavrl.deployment.runtime", "from uavrl.errors import UavrlError", "this module stands alone"),
        ("uavrl", "from uavrl.scenario import Scenario", "holds the version only"),
    ],
)
def test_a_violation_is_found(module: str, source: str, reason: str) -> None:
    found = violations(source, module)
    assert len(found) == 1
    assert reason in found[0]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("uavrl.simulation.state", "from uavrl.physics.age import next_age_s"),
        ("uavrl.simulation.state", "from .dynamics import advance"),
        ("uavrl.agents.sac", "import torch\nfrom uavrl.networks import mlp\nfrom uavrl.errors import ConfigError"),
        ("uavrl.deployment.runtime", "import json\nimport numpy as np\nimport onnxruntime"),
        ("uavrl.cli.version", "from uavrl import __version__"),
    ],
)
def test_what_is_allowed_is_not_reported(module: str, source: str) -> None:
    assert violations(source, module) == []


def test_a_relative_import_of_a_package_is_resolved_from_the_package() -> None:
    assert list(imports("from .sac import Sac", "uavrl.agents", is_package=True)) == [(1, "uavrl.agents.sac.Sac")]
    assert list(imports("from .sac import Sac", "uavrl.agents.bc")) == [(1, "uavrl.agents.sac.Sac")]
