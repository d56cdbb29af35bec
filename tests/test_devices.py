"""What is said of the devices at hand, and that a GPU's memory is not taken whole."""

import os

import pytest

from launch.devices import PREALLOCATE, Devices, find_devices, share_gpu
from launch.main import main

CPU = Devices(cuda=(), jax=("cpu",), backend="cpu")
BOTH = Devices(cuda=("H200",), jax=("NVIDIA H200",), backend="gpu")
SHARED = {PREALLOCATE: "false"}


def test_the_users_setting_wins():
    environment: dict[str, str] = {}
    share_gpu(environment)
    assert environment == SHARED
    own = {PREALLOCATE: "true"}
    share_gpu(own)
    assert own == {PREALLOCATE: "true"}


def test_every_command_shares_the_gpu(monkeypatch):
    monkeypatch.delenv(PREALLOCATE, raising=False)
    assert main(["no-such-command"]) == 2
    assert os.environ[PREALLOCATE] == "false"


@pytest.mark.parametrize(
    ("found", "environment", "use", "advice"),
    [
        (CPU, SHARED, "learner on cpu; actors and rendering on cpu", ""),
        (BOTH, SHARED, "H200 by --learner.device auto, else cpu; actors", ""),
        (
            BOTH,
            {},
            "rendering on NVIDIA H200",
            f"{PREALLOCATE} is not false: JAX takes",
        ),
    ],
)
def test_what_a_run_would_use(found, environment, use, advice):
    assert use in found.use()
    assert found.advice(environment).startswith(advice)
    assert bool(found.advice(environment)) == bool(advice)


def test_a_library_without_the_gpu_is_named():
    lacking = Devices(cuda=("H200",), jax=("cpu",), backend="cpu")
    assert lacking.advice(SHARED).startswith("torch finds a GPU and jax none")
    other = Devices(cuda=(), jax=("NVIDIA H200",), backend="gpu")
    assert other.advice(SHARED).startswith("jax finds a GPU and torch none")


@pytest.mark.slow
def test_this_machine_is_asked():
    found = find_devices()
    assert found.jax
    assert found.backend in ("cpu", "gpu", "tpu")
