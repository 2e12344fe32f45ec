"""Process-wide settings, made before JAX is used: compilation cache, allocator, devices, distributed jobs.

The command line, the experiments and the benchmarks call these; importing the library changes no setting.
"""

from __future__ import annotations

import ctypes
import logging
import os
import socket
import sys

import jax

from facejax.io import cache

MAX_FREE_BYTES = (1 << 31) - 1  # freed memory that the allocator may keep
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
_JOB_VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def configure() -> None:
    """Call `compile_cache`, `keep_memory` and `quiet_warnings`."""
    compile_cache()
    keep_memory()
    quiet_warnings()


def quiet_warnings() -> None:
    """Silence the loggers of Orbax and asyncio, whose errors also reach the caller as exceptions.

    If a checkpoint cannot be written or read, they log hundreds of lines before the exception is raised.
    """
    for name in ("asyncio", "absl"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def compile_cache() -> None:
    """Enable JAX's persistent compilation cache in the user's cache folder: the second start is then faster."""
    jax.config.update("jax_compilation_cache_dir", str(cache.folder() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def keep_memory() -> bool:
    """Let glibc's allocator keep freed memory; return whether it could be set.

    By default large arrays are unmapped when they are freed, and the next one's pages are faulted in and zeroed again,
    which can take longer than the arithmetic: encoding 1,000 motions takes 3.4 ms instead of 13. At most 2 GB are
    kept. For processes on a CPU, where arrays of some 10 MB come and go. Without glibc it does nothing. Arenas of
    other threads still return their memory: a single arena for all threads would keep that too, but PyTorch then took
    up to five times as long.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return False
    return bool(mallopt(_MMAP_THRESHOLD, 1 << 30) and mallopt(_TRIM_THRESHOLD, MAX_FREE_BYTES))


def use_all_cores() -> None:
    """Make every core of the processor a device of JAX.

    `training.steps.vectorize_models` then distributes its models over them, `training.sharding.data_parallel` its
    batch. Raises `RuntimeError` where JAX has been used before.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    jax.config.update("jax_num_cpu_devices", cores or 1)


def join_distributed(*, patience: int = 20) -> None:
    """Join the other processes of a distributed job, before any other use of JAX.

    Calls `jax.distributed.initialize` with JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES
    and JAX_PROCESS_ID (from 0); without these variables JAX detects the job of Slurm, Open MPI and others.
    `jax.devices()` are then those of all processes. All processes have to join within five minutes, or JAX ends the
    process. One that joined and sends no heartbeat for `patience` seconds is lost, and ends the others.

    Raises:
      ValueError: variables are missing or malformed, or no job was detected.
    """
    values = [os.environ[name] for name in _JOB_VARIABLES if name in os.environ]
    if len(values) not in (0, len(_JOB_VARIABLES)) or not all(number.isdigit() for number in values[1:]):
        raise ValueError(
            f"expected all of {', '.join(_JOB_VARIABLES)}, the last two whole numbers, or none; got {values}"
        )
    address, count, index = (values[0], int(values[1]), int(values[2])) if values else (None, None, None)
    if values:
        _check_address(values[0])
        print(f"waiting for {values[1]} processes at {values[0]}", file=sys.stderr, flush=True)
    try:
        jax.distributed.initialize(
            address, count, index, heartbeat_timeout_seconds=patience, shutdown_timeout_seconds=patience
        )
    except ValueError as error:
        if values:
            raise
        raise ValueError(f"no job to join ({error}): set {', '.join(_JOB_VARIABLES)}") from error


def _check_address(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"JAX_COORDINATOR_ADDRESS: expected host:port, got {address}")
    try:
        socket.getaddrinfo(host.strip("[]"), int(port))
    except OSError as error:
        raise ValueError(f"JAX_COORDINATOR_ADDRESS: {host} is an unknown host ({error.strerror})") from error
