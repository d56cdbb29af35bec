"""Shared by all tests: annotations become checks, and fixtures for the data.

The import hook has to be installed before the first import of a package of ours,
so it stands above everything else. `is_pep484_tower` lets an `int` pass for a
`float`, as type checkers do.
"""

from jaxtyping import install_import_hook

install_import_hook(
    ["sim", "replay", "actors", "learner", "launch"],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

import os  # noqa: E402
import signal  # noqa: E402
import threading  # noqa: E402
from pathlib import Path  # noqa: E402

# A shell's background job has Ctrl-C ignored, and so have the processes that it starts:
# those that tests interrupt would not notice.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Many tests, and the processes that they start, compile the same programs: each is
# compiled once. Set before JAX is imported, so that those processes have it too.
CACHE = Path(__file__).parent.parent / ".pytest_cache" / "xla"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax  # noqa: E402
import pytest  # noqa: E402

from sim.bank import BankFile  # noqa: E402
from sim.scene import Scene  # noqa: E402
from tests import scenes  # noqa: E402

# Broadcasting and promotion are spelled out in the code: a missing axis or a stray
# float64 is a bug to find here, not a slow or wrong program later.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(scope="session")
def scenes_data() -> Path:
    """The folder of real scenes; a test that needs it is skipped without it."""
    value = os.environ.get("SLIPSTREAM_DATA", "")
    if not value:
        pytest.skip("SLIPSTREAM_DATA is not set: no real scenes to test on")
    path = Path(value)
    if not path.is_dir():
        pytest.skip(f"SLIPSTREAM_DATA: no folder {path}")
    return path


@pytest.fixture(scope="session")
def real(
    scenes_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[tuple[Scene, ...], BankFile]:
    """Every recorded scene, and one bank of them all."""
    recorded = scenes.real(scenes_data)
    return recorded, scenes.bank_of(recorded, tmp_path_factory.mktemp("real"))
