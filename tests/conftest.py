"""What every test shares: repeatable property tests, and no writing outside the test's own folders."""

import signal

import pytest
from hypothesis import settings

# Shared cores make single examples slow at random, and a failure must come back on the next run.
settings.register_profile("uavrl", deadline=None, derandomize=True)
settings.load_profile("uavrl")


@pytest.fixture(autouse=True)
def _interrupts_are_heard() -> None:
    """A shell's background jobs ignore the interrupt, and so would a test run that is started as one."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _datasets_in_a_temporary_folder(tmp_path_factory: pytest.TempPathFactory) -> object:
    """Minari keeps its datasets in the home folder unless told otherwise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield
