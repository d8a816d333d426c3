"""A frame shows what is so: colours are those of the ages, links and paths are where they should be."""

from __future__ import annotations

import subprocess
import sys
import time

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from uavrl.scenario import load_scenario
from uavrl.simulation import rendering
from uavrl.simulation.environment import DataCollectionEnv
from uavrl.simulation.rendering import AGE_COLOURS, draw_frame, numbered

SCENARIO = load_scenario("released", devices=3)
LAYOUT = np.array([[200.0, 500.0], [500.0, 500.0], [800.0, 500.0]])
AGES = np.array([0.3, 8.0, 300.0])
PATH = np.array([[500.0, 100.0], [500.0, 200.0]])
WHITE, BLUE = (255, 255, 255), (0x00, 0x72, 0xB2)


def pixel(position_m: NDArray[np.float64]) -> tuple[int, int]:
    """(column, row) at which a position of the map is drawn."""
    canvas, axes, *_ = rendering._stage(SCENARIO)
    x, y = axes.transData.transform(position_m)
    return round(float(x)), round(float(canvas.figure.bbox.height - y))


def around(frame: NDArray[np.uint8], position_m: NDArray[np.float64], radius: int) -> NDArray[np.uint8]:
    x, y = pixel(position_m)
    return frame[y - radius : y + radius + 1, x - radius : x + radius + 1].reshape(-1, 3)


def count(pixels: NDArray[np.uint8], colour: tuple[int, ...], tolerance: int = 12) -> int:
    return int((np.abs(pixels.astype(int) - colour).max(axis=-1) <= tolerance).sum())


def test_every_device_has_the_colour_of_its_age_on_the_scale_of_the_scenario() -> None:
    frame = draw_frame(SCENARIO, LAYOUT, PATH, AGES, 0)
    for position, age in zip(LAYOUT, AGES, strict=True):
        shade = np.asarray(mpl.colormaps[AGE_COLOURS](LogNorm(0.1, 400.0)(age)))[:3] * 255
        assert count(around(frame, position, 9), tuple(shade.astype(int))) > 100


def test_an_age_of_zero_and_one_beyond_the_limit_are_drawn() -> None:
    frame = draw_frame(SCENARIO, LAYOUT, PATH, np.array([0.0, 1.0, 1e6]), 0)
    ends = [tuple((np.array(mpl.colormaps[AGE_COLOURS](end)[:3]) * 255).astype(int)) for end in (0.0, 1.0)]
    assert count(around(frame, LAYOUT[0], 9), ends[0]) > 100
    assert count(around(frame, LAYOUT[2], 9), ends[1]) > 100


def test_the_link_goes_to_the_served_device_and_is_absent_without_one() -> None:
    frames = {served: draw_frame(SCENARIO, LAYOUT, PATH, AGES, served) for served in (0, 1, 3)}
    for served, other in ((1, 3), (3, 1)):
        spot = PATH[-1] + 0.5 * (LAYOUT[served - 1] - PATH[-1])
        dark = [int((around(frames[index], spot, 8).max(axis=1) < 120).sum()) for index in (served, other, 0)]
        assert dark[0] > 5
        assert dark[1:] == [0, 0]


def test_the_path_is_drawn_where_it_went_and_the_aircraft_at_its_end() -> None:
    path = np.array([[100.0, 100.0], [100.0, 900.0], [900.0, 900.0]])
    frame = draw_frame(SCENARIO, LAYOUT, path, AGES, 0)
    blueish = (0x33, 0x8E, 0xC1)  # BLUE at 80 % over white
    assert count(around(frame, np.array([100.0, 500.0]), 3), blueish, 40) >= 5
    assert count(around(frame, np.array([900.0, 500.0]), 3), blueish, 40) == 0
    assert count(around(frame, path[-1], 6), BLUE) > 30


def test_a_frame_leaves_nothing_behind_for_the_next() -> None:
    first = draw_frame(SCENARIO, LAYOUT, PATH, AGES, 2)
    kept, held = first.copy(), len(rendering._stage(SCENARIO)[1].get_children())
    other = draw_frame(SCENARIO, LAYOUT[::-1], PATH[::-1], AGES[::-1], 0)
    assert (first == kept).all()
    assert (other != first).any()
    assert (draw_frame(SCENARIO, LAYOUT, PATH, AGES, 2) == kept).all()
    assert len(rendering._stage(SCENARIO)[1].get_children()) == held  # or every frame would cost memory


@pytest.mark.parametrize(("devices", "width_m"), [(1, 1000.0), (30, 5000.0), (100, 300.0)])
def test_any_number_of_devices_and_any_area_fit_one_size(devices: int, width_m: float) -> None:
    scenario = load_scenario("released", devices=devices, width_m=width_m)
    layout = np.random.default_rng(1).uniform(0, 1, (devices, 2)) * [width_m, 1000.0]
    frame = draw_frame(scenario, layout, PATH[:1], np.ones(devices), devices)
    assert frame.shape == (560, 640, 3)
    assert frame.dtype == np.uint8
    border = np.concatenate([frame[:2].reshape(-1, 3), frame[-2:].reshape(-1, 3), frame[:, :2].reshape(-1, 3)])
    assert (border == WHITE).all()  # nothing runs out of the picture


def test_numbers_are_left_out_where_a_later_dot_would_hide_them() -> None:
    layout = np.array([[0.0, 0.0], [10.0, 0.0], [100.0, 0.0], [101.0, 0.0]])
    assert numbered(layout, 5.0).tolist() == [0, 1, 3]
    assert numbered(layout, 20.0).tolist() == [1, 3]
    assert numbered(np.zeros((31, 2)), 0.0).size == 0


def test_the_environment_renders_the_state_it_is_in() -> None:
    env = DataCollectionEnv("released", layout=LAYOUT, render_mode="rgb_array", devices=3, fading="none")
    env.reset(seed=0, options={"position_m": [500.0, 100.0]})
    still = env.render()
    for _ in range(3):
        env.step({"displacement_m": np.array([0.0, 25.0]), "device": 2})
    frame = env.render()
    path = np.array([[500.0, 100.0 + 25.0 * step] for step in range(4)])
    assert still is not None
    assert frame is not None
    assert (still != frame).any()
    assert (frame == draw_frame(env.scenario, LAYOUT, path, env.state.age_s, 2)).all()


def test_pyplot_stays_out() -> None:
    script = (
        "import sys; import numpy as np; from uavrl.scenario import load_scenario;"
        "from uavrl.simulation.rendering import draw_frame;"
        "draw_frame(load_scenario('released', devices=1), np.ones((1, 2)), np.ones((1, 2)), np.ones(1), 1);"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


def test_ten_frames_a_second() -> None:
    scenario = load_scenario("released")
    generator = np.random.default_rng(0)
    layout, path = generator.uniform(0, 1000, (10, 2)), generator.uniform(0, 1000, (400, 2))
    seconds = []
    for served in range(6):
        start = time.process_time()  # of this process alone: other work on the machine does not count
        draw_frame(scenario, layout, path, np.ones(10), served)
        seconds.append(time.process_time() - start)
    assert min(seconds) < 0.1
