from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from uavrl.errors import CheckpointError
from uavrl.training import checkpoint as module
from uavrl.training.checkpoint import MANIFEST, load_checkpoint, numpy_state, recover, save_checkpoint, set_numpy_state

TENSORS = {
    "networks": {"a.weight": torch.arange(6.0).view(2, 3), "flag": torch.tensor([True, False])},
    "loop": {"generator": torch.Generator().manual_seed(3).get_state(), "step": torch.tensor(7)},
}


def save(path: Path, number: int) -> None:
    save_checkpoint(path, {"kind": "test", "step": number}, TENSORS | {"more": {"x": torch.full((3,), float(number))}})


def test_what_is_loaded_is_what_was_saved(tmp_path: Path) -> None:
    save(tmp_path / "deep" / "c", 1)
    found = load_checkpoint(tmp_path / "deep" / "c")
    assert found.document["kind"] == "test"
    assert set(found.document["versions"]) == {"uavrl", "python", "torch"}
    assert {name: set(entries) for name, entries in found.tensors.items()} == {
        "networks": {"a.weight", "flag"},
        "loop": {"generator", "step"},
        "more": {"x"},
    }
    for name, entries in TENSORS.items():
        for key, value in entries.items():
            assert found.tensors[name][key].dtype == value.dtype
            assert torch.equal(found.tensors[name][key], value)
    assert sorted(path.name for path in (tmp_path / "deep").iterdir()) == ["c"]  # nothing temporary stays


def test_tensors_that_share_memory_or_are_views_are_saved_whole(tmp_path: Path) -> None:
    whole = torch.arange(12.0).view(3, 4)
    save_checkpoint(tmp_path / "c", {}, {"t": {"whole": whole, "same": whole, "turned": whole.T, "row": whole[1]}})
    found = load_checkpoint(tmp_path / "c").tensors["t"]
    assert torch.equal(found["turned"], whole.T)
    assert torch.equal(found["same"], whole)
    assert torch.equal(found["row"], whole[1])


@pytest.mark.parametrize("file", [MANIFEST, "networks.safetensors", "more.safetensors"])
def test_a_file_cut_at_any_place_is_found_in_one_line(tmp_path: Path, file: str) -> None:
    save(tmp_path / "c", 1)
    path = tmp_path / "c" / file
    content = path.read_bytes()
    for length in sorted({0, 1, 7, 8, 9, *range(0, len(content), max(1, len(content) // 23)), len(content) - 1}):
        path.write_bytes(content[:length])
        with pytest.raises(CheckpointError, match=file) as error:
            load_checkpoint(tmp_path / "c")
        assert "\n" not in str(error.value)
    path.unlink()
    with pytest.raises(CheckpointError, match=file):
        load_checkpoint(tmp_path / "c")
    path.write_bytes(content)
    load_checkpoint(tmp_path / "c")


def test_an_altered_byte_is_found(tmp_path: Path) -> None:
    save(tmp_path / "c", 1)
    path = tmp_path / "c" / "networks.safetensors"
    content = bytearray(path.read_bytes())
    content[-2] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(tmp_path / "c")


@pytest.mark.parametrize("text", ["", "[]", "null", "{}", '{"files": 3}', '{"files": {}', "\ud83d"])
def test_a_manifest_of_something_else_is_found(tmp_path: Path, text: str) -> None:
    save(tmp_path / "c", 1)
    (tmp_path / "c" / MANIFEST).write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(CheckpointError, match=MANIFEST):
        load_checkpoint(tmp_path / "c")


def test_a_place_without_a_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"'.*nowhere' does not exist"):
        load_checkpoint(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match=f"it has no {MANIFEST}"):
        load_checkpoint(tmp_path)
    assert recover(tmp_path / "nowhere") is None


class Killed(BaseException):
    """The process is gone at this point."""


@pytest.mark.parametrize("point", ["save_file", "_sync", "rename 1", "rename 2"])
def test_a_writer_killed_anywhere_leaves_a_whole_checkpoint(
    tmp_path: Path, point: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in every call of `point`, one after the other: what recovers is the old checkpoint, or the new one."""
    for call in range(1, 8):
        place = tmp_path / f"{point} {call}" / "c"
        save(place, 1)
        calls = 0

        def fail(original: object, at: int) -> object:
            def run(*arguments: object) -> object:
                nonlocal calls
                calls += 1
                if calls == at:
                    raise Killed
                return original(*arguments)  # type: ignore[operator]  # one of the functions below

            return run

        with monkeypatch.context() as patch:
            if point.startswith("rename"):
                patch.setattr(Path, "rename", fail(Path.rename, int(point[-1])))
            else:
                patch.setattr(module, point, fail(getattr(module, point), call))
            try:
                save(place, 2)
            except Killed:
                pass
            else:
                assert call > 1
                break  # fewer calls than that
        found = recover(place)
        assert found == place
        step = load_checkpoint(place).document["step"]
        renamed = not point.startswith("rename") and calls > 5  # the last sync is of the folder after both renames
        assert step == (2 if renamed else 1)
        save(place, 3)  # and the next writer is not in the way of what was left, of the same process number even
        assert load_checkpoint(place).document["step"] == 3
        if point.startswith("rename"):
            break


def test_leftovers_of_a_killed_writer_of_the_same_number_are_no_obstacle(tmp_path: Path) -> None:
    save(tmp_path / "c", 1)
    shutil.copytree(tmp_path / "c", tmp_path / f".c.{os.getpid()}.old")
    shutil.copytree(tmp_path / "c", tmp_path / f".c.{os.getpid()}.tmp")
    save(tmp_path / "c", 2)
    assert load_checkpoint(tmp_path / "c").document["step"] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


def test_a_checkpoint_that_was_being_replaced_is_put_back(tmp_path: Path) -> None:
    save(tmp_path / "c", 1)
    (tmp_path / "c").rename(tmp_path / ".c.4711.old")
    assert recover(tmp_path / "c") == tmp_path / "c"
    assert load_checkpoint(tmp_path / "c").document["step"] == 1


def test_a_numpy_generator_goes_on_from_json() -> None:
    first, second = np.random.default_rng(1), np.random.default_rng(2)
    first.random(5)
    first.integers(0, 7)  # leaves half of a 64-bit draw behind, which is part of the state
    set_numpy_state(second, json.loads(json.dumps(numpy_state(first))))
    assert first.integers(0, 7) == second.integers(0, 7)
    assert (first.random(5) == second.random(5)).all()
