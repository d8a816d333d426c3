"""What is installed is what is in the tree: one version, all data files, all requirements declared and pinned."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import uavrl

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "uavrl"
# Where the name to import is not the name to install.
INSTALLED_AS = {"PIL": "pillow", "yaml": "pyyaml", "h5py": "minari"}  # h5py is minari[hdf5]


def imported() -> dict[str, str]:
    """Modules of others that the package imports, with one of the files that do."""
    used: dict[str, str] = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            used |= {name.partition(".")[0]: path.name for name in names}
    return {name: file for name, file in used.items() if name not in sys.stdlib_module_names | {"uavrl"}}


def installed_as(module: str) -> str:
    return canonicalize_name(INSTALLED_AS.get(module, module))


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return project


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


def requirements(project: dict[str, Any]) -> list[Requirement]:
    extras = project["optional-dependencies"].values()
    every = [Requirement(text) for text in [*project["dependencies"], *(text for extra in extras for text in extra)]]
    return [one for one in every if one.name != "uavrl"]  # an extra that takes up others


def test_the_installed_version_is_the_source_s() -> None:
    assert metadata.version("uavrl") == uavrl.__version__


def test_the_citation_names_this_version_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == uavrl.__version__
    assert citation["license"] == "MIT"
    (paper,) = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Eldeeb", "Alves"]
    assert {"type": "other", "value": "arXiv:2606.16331"}.items() <= paper["identifiers"][0].items()


def test_the_changelog_has_an_entry_for_this_version() -> None:
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert uavrl.__version__ in headings


def test_the_wheel_ships_every_file_of_the_package(wheel: Path) -> None:
    listed = subprocess.run(["git", "ls-files", "src/uavrl"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    tracked = {name.removeprefix("src/") for name in listed.stdout.splitlines() if (ROOT / name).exists()}
    shipped = set(zipfile.ZipFile(wheel).namelist())
    assert "uavrl/py.typed" in shipped
    assert tracked - shipped == set()
    assert any(name.endswith("/licenses/LICENSE") for name in shipped)


def test_the_wheel_is_importable_by_itself(wheel: Path) -> None:
    code = f"import sys; sys.path.insert(0, {str(wheel)!r}); import uavrl; print(uavrl.__file__, uavrl.__version__)"
    result = subprocess.run([sys.executable, "-I", "-S", "-c", code], check=True, capture_output=True, text=True)
    file, version = result.stdout.split()
    assert file.startswith(str(wheel))
    assert version == uavrl.__version__


def test_the_command_is_installed() -> None:
    (script,) = metadata.entry_points(group="console_scripts", name="uavrl")
    assert script.value == "uavrl.cli:main"


def test_every_import_is_declared(project: dict[str, Any]) -> None:
    declared = {canonicalize_name(requirement.name) for requirement in requirements(project)}
    missing = {name: file for name, file in imported().items() if installed_as(name) not in declared}
    assert not missing, f"not in pyproject.toml: {missing}"


def test_every_requirement_of_a_user_is_imported(project: dict[str, Any]) -> None:
    extras = {name: lines for name, lines in project["optional-dependencies"].items() if name != "dev"}
    declared = {Requirement(line).name for lines in (project["dependencies"], *extras.values()) for line in lines}
    wanted_by_others = {"pillow", "tensorboard", "onnx"}  # by minari and torch, which do not declare them
    idle = {canonicalize_name(name) for name in declared} - wanted_by_others - {*map(installed_as, imported())}
    assert not idle, f"in pyproject.toml, imported nowhere: {idle}"


def test_every_requirement_is_pinned_within_its_bounds(project: dict[str, Any]) -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    for requirement in requirements(project):
        pin = pins.get(canonicalize_name(requirement.name))
        assert pin is not None, f"{requirement} has no pin in constraints.txt"
        assert pin in requirement.specifier, (
            f"constraints.txt pins {requirement.name}=={pin}, declared is {requirement}"
        )


def test_the_pinned_torch_suits_any_build(project: dict[str, Any]) -> None:
    assert "+" not in (ROOT / "constraints.txt").read_text().split("torch==")[1].splitlines()[0]
