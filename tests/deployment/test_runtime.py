"""What a policy on board accepts, refuses and answers, and what it needs."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import venv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.agents.problems import observation
from tests.deployment.conftest import Exported
from uavrl.deployment import Policy, PolicyError

ROOT = Path(__file__).parents[2]


def one_set(devices: int = 4, seed: int = 0) -> dict[str, Any]:
    seen = observation("devices", 1, seed, devices)
    assert isinstance(seen, dict)
    return {key: value[0].numpy().astype(float) for key, value in seen.items()}


def changed(name: str, place: tuple[int, ...], value: float) -> dict[str, Any]:
    seen = one_set()
    seen[name][place] = value
    return seen


@pytest.fixture
def policy(exported: Exported) -> Policy:
    return Policy(exported("gaussian_bc", "devices", False, 10)[1])


@pytest.fixture
def perceptron(exported: Exported) -> Policy:
    return Policy(exported("gaussian_bc", "mlp", False, 10)[1])


@pytest.fixture
def sampled(exported: Exported) -> Path:
    return exported("gaussian_bc", "devices", True, 10)[1]


def test_one_aircraft_and_many_are_answered_alike(policy: Policy) -> None:
    many = [one_set(seed=seed) for seed in range(8)]
    batch = policy.decide({key: np.stack([one[key] for one in many]) for key in ("uav", "devices")})
    assert batch.displacement_m.shape == (8, 2)
    for row, one in enumerate(many):
        displacement_m, device = policy.decide({key: value.tolist() for key, value in one.items()})
        assert isinstance(device, int)
        assert device == batch.device[row]
        np.testing.assert_allclose(displacement_m, batch.displacement_m[row], atol=1e-4)


def test_an_answer_stays_when_the_next_question_is_asked(policy: Policy) -> None:
    """Of one aircraft, the model reads and writes the same arrays each time; of each number of devices its own."""
    seen = [one_set(devices=devices, seed=seed) for seed in range(4) for devices in (2, 4, 3)]
    answers = [policy.decide(one) for one in seen]
    again = [policy.decide(one) for one in reversed(seen)][::-1]
    for before, after in zip(answers, again, strict=True):
        assert before.displacement_m.tobytes() == after.displacement_m.tobytes()
        assert before.device == after.device
    assert len({answer.displacement_m.tobytes() for answer in answers}) == len(seen)


def test_threads_that_share_a_policy_get_their_own_answers(policy: Policy) -> None:
    seen = [one_set(seed=seed) for seed in range(4)]
    alone = [policy.decide(one).displacement_m.tobytes() for one in seen]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(len(seen)) as pool:
            found = pool.map(lambda one: {policy.decide(one).displacement_m.tobytes() for _ in range(5_000)}, seen)
            assert list(found) == [{answer} for answer in alone]
    finally:
        sys.setswitchinterval(before)


def test_a_missing_reading_has_no_say_and_is_never_chosen(policy: Policy) -> None:
    for seed in range(50):
        whole = one_set(devices=4, seed=seed)
        lost = {"uav": whole["uav"], "devices": np.insert(whole["devices"], 2, np.nan, axis=0)}
        lost["devices"][2, -1] = 0.0
        expected, found = policy.decide(whole), policy.decide(lost)
        np.testing.assert_allclose(found.displacement_m, expected.displacement_m, atol=1e-4)
        assert found.device == expected.device + (expected.device >= 3)  # the numbers behind it move up


def test_without_any_reading_it_hovers_and_serves_nobody(policy: Policy) -> None:
    seen = {key: np.stack([value, value]) for key, value in one_set().items()}
    seen["devices"][0] = np.nan
    seen["devices"][0, :, -1] = 0.0
    found, alone = policy.decide(seen), policy.decide({key: value[1] for key, value in seen.items()})
    assert found.device[0] == 0
    assert (found.displacement_m[0] == 0.0).all()
    np.testing.assert_allclose(found.displacement_m[1], alone.displacement_m, atol=1e-4)
    assert policy.decide({key: value[0] for key, value in seen.items()}).device == 0


def test_an_age_beyond_the_largest_counts_as_the_largest(policy: Policy, perceptron: Policy) -> None:
    older, oldest = (policy.decide(changed("devices", (1, 2), age)) for age in (3000.0, 400.0))
    assert (older.displacement_m == oldest.displacement_m).all()
    vector = np.ones(13)
    vector[5] = 400.0
    expected = perceptron.decide(vector)
    vector[5] = 3000.0
    assert (perceptron.decide(vector).displacement_m == expected.displacement_m).all()


def test_a_packet_that_took_an_hour_is_no_mistaken_unit(policy: Policy) -> None:
    """In Rayleigh fading a step's energy has no largest value, and the simulator says what it was."""
    assert np.isfinite(policy.decide(changed("uav", (2,), 1e5)).displacement_m).all()
    with pytest.raises(PolicyError, match=r"uav\[2\], energy_j = -1, allowed: 0 to"):
        policy.decide(changed("uav", (2,), -1.0))


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (changed("devices", (1, 2), np.nan), "devices[1, 2], age_s = nan, allowed: 0 to 4000"),
        (changed("devices", (1, 2), 60_000.0), "devices[1, 2], age_s = 60000, allowed: 0 to 4000"),  # ms
        (changed("devices", (0, 4), 2e6), "devices[0, 4], packet_mbit = 2e+06, allowed: 0 to 20"),  # bit
        (changed("devices", (3, 5), 0.5), "devices[3, 5], valid = 0.5, allowed: 0 or 1"),
        (changed("uav", (0,), 5e5), "uav[0], x_m = 500000, allowed: -10000 to 10000"),  # mm
        (changed("uav", (1,), np.inf), "uav[1], y_m = inf"),
        (changed("uav", (3,), 55.0), "uav[3], energy_left = 55, allowed: 0 to 1"),  # per cent
        ({"uav": np.ones(4), "devices": np.ones((4, 5))}, "devices has shape (4, 5), needed: (K, 6), or (B, K, 6)"),
        ({"uav": np.ones(3), "devices": np.ones((4, 6))}, "uav has shape (3,), needed: (4,), or (B, 4)"),
        ({"uav": np.ones((2, 4)), "devices": np.ones((4, 6))}, "uav has shape (2, 4) and devices (4, 6)"),
        ({"uav": np.ones(4), "devices": np.ones((0, 6))}, "devices has shape (0, 6)"),
        ({"uav": np.ones(4)}, "observation is ['uav'], needed: a mapping of 'uav' (4,), 'devices' (K, 6)"),
        ({"uav": ["here"] * 4, "devices": np.ones((4, 6))}, "uav holds something that is no number"),
        (np.ones(13), "observation is ndarray, needed: a mapping"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(policy: Policy, seen: Any, message: str) -> None:
    with pytest.raises(PolicyError) as caught:
        policy.decide(seen)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (np.ones(12), "observation has shape (12,), needed: (13,), or (B, 13) for B aircraft"),
        (np.full(13, -1.0), "observation[2], age_s of device 1 = -1, allowed: 0 to 4000"),
        (one_set(), "observation holds something that is no number"),
    ],
)
def test_a_perceptron_refuses_too(perceptron: Policy, seen: Any, message: str) -> None:
    with pytest.raises(PolicyError) as caught:
        perceptron.decide(seen)
    assert message in str(caught.value)


def test_noise_makes_a_sample_and_equal_noise_the_same(sampled: Path, policy: Policy) -> None:
    first, second, seen = Policy(sampled, seed=1), Policy(sampled, seed=1), one_set()
    drawn = [first.decide(seen) for _ in range(20)]
    assert len({one.displacement_m.tobytes() for one in drawn}) > 1
    for one in drawn:
        assert second.decide(seen).displacement_m.tobytes() == one.displacement_m.tobytes()
    noise = first.draw_noise(1, 4)
    assert first.decide(seen, noise).displacement_m.tobytes() == second.decide(seen, noise).displacement_m.tobytes()
    with pytest.raises(PolicyError, match=r"noise has shape \(1, 1, 6\), needed: \(1, 1, 7\), finite"):
        first.decide(seen, noise[..., 1:])
    with pytest.raises(PolicyError, match="without --sampled"):
        policy.decide(seen, noise)


def test_what_is_no_exported_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="does not exist"):
        Policy(tmp_path / "gone.onnx")
    (tmp_path / "cut.onnx").write_bytes(b"not a model")
    with pytest.raises(PolicyError, match=r"cut\.onnx' cannot be read"):
        Policy(tmp_path / "cut.onnx")
    onnx = pytest.importorskip("onnx")
    x = onnx.helper.make_tensor_value_info("x", 1, [1])
    y = onnx.helper.make_tensor_value_info("y", 1, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "other", [x], [y])
    other = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(other, str(tmp_path / "other.onnx"))
    with pytest.raises(PolicyError, match="no metadata 'uavrl', needed: a file written by `uavrl export`"):
        Policy(tmp_path / "other.onnx")


DECIDE = """
    import sys
    from uavrl.deployment import Policy
    policy = Policy(sys.argv[1])
    displacement_m, device = policy.decide({"uav": [500, 400, 5, 1], "devices": [[10, 20, 3, 1, 2, 1]] * 3})
    assert displacement_m.shape == (2,) and 0 <= device <= 3
    heavy = {"torch", "pydantic", "gymnasium", "scipy", "onnx", "tyro"} & {*sys.modules}
    assert not heavy, heavy
    print("decided", policy)
"""

# Every other package is as if it were not installed.
ALONE = """
    import sys
    from importlib.machinery import BuiltinImporter, FrozenImporter, PathFinder

    class Few:
        def find_spec(name, path=None, target=None):
            top = name.partition(".")[0]
            allowed = {*sys.stdlib_module_names, "numpy", "onnxruntime", "uavrl"}
            return PathFinder.find_spec(name, path, target) if top in allowed else None

    sys.meta_path[:] = [BuiltinImporter, FrozenImporter, Few]
"""


def test_it_decides_where_nothing_but_numpy_and_onnxruntime_can_be_imported(exported: Exported) -> None:
    path = exported("gaussian_bc", "devices", False, 10)[1]
    script = textwrap.dedent(ALONE) + textwrap.dedent(DECIDE)
    result = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "decided Policy('gaussian_bc', scenario='released', any K)\n"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_it_decides_in_an_environment_without_torch(exported: Exported, tmp_path: Path) -> None:
    path = exported("gaussian_bc", "devices", False, 10)[1]
    venv.create(tmp_path / "onboard", with_pip=True)
    python = str(tmp_path / "onboard" / "bin" / "python")
    pip = [python, "-m", "pip", "install", "--quiet", "--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, "numpy", "onnxruntime"], check=True)
    subprocess.run([*pip, "--no-deps", str(ROOT)], check=True)
    command = [python, "-c", textwrap.dedent(DECIDE), str(path)]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("decided")
    listed = subprocess.run([python, "-m", "pip", "list"], capture_output=True, text=True, check=True).stdout
    assert "torch" not in listed
