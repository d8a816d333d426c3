from __future__ import annotations

import csv
from pathlib import Path

import pytest
from PIL import Image

from tests.experiments.rows import finished_figures
from uavrl.experiments.paper import FIGURES
from uavrl.experiments.plots import draw, numbers


@pytest.mark.parametrize("name", list(FIGURES))
def test_each_figure_is_drawn_from_the_numbers_beside_it(name: str, tmp_path: Path) -> None:
    rows = finished_figures()[name]
    table, picture, document = draw(name, rows, tmp_path)
    with table.open() as file:
        points = list(csv.DictReader(file))
    assert len(points) == len(numbers(FIGURES[name], rows))
    assert {point["name"] for point in points} == {row["variant"].split(" @ ")[0] for row in rows}
    with Image.open(picture) as image:
        assert image.width > 700
        assert len(set(image.convert("L").tobytes())) > 20
    assert document.read_bytes().startswith(b"%PDF")


def test_equal_numbers_make_equal_files(tmp_path: Path) -> None:
    rows = finished_figures()["comparison"]
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        draw("comparison", rows, tmp_path / place)
    for suffix in ("png", "pdf", "csv"):
        assert (tmp_path / f"a/comparison.{suffix}").read_bytes() == (tmp_path / f"b/comparison.{suffix}").read_bytes()


def test_a_curve_is_the_mean_over_seeds_at_each_point() -> None:
    rows = finished_figures()["comparison"]
    points = [p for p in numbers(FIGURES["comparison"], rows) if p["name"] == "CQL" and p["metric"] == "return"]
    assert [(p["at"], p["mean"]) for p in points[:2]] == [(5, -480.0), (10, -240.0)]
    assert points[2]["at"] == "final"
    assert points[2]["seeds"] == 2
