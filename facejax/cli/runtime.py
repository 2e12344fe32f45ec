"""What a program may set once, before it uses JAX: compiled programs that are kept, memory that is kept, every core.

The command line, the experiments and the benchmarks do; a library that is imported changes nothing by itself.
"""

from __future__ import annotations

import ctypes
import logging
import os
import socket
import sys

import jax

from facejax.io import cache

KEPT = (1 << 31) - 1  # bytes that stay with the process though nobody uses them
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
_JOB = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def configure() -> None:
    """`compile_cache`, `keep_memory` and `quiet_warnings`."""
    compile_cache()
    keep_memory()
    quiet_warnings()


def quiet_warnings() -> None:
    """Let libraries keep to themselves what comes as an exception anyway.

    Where a checkpoint cannot be written or read, Orbax's tasks log hundreds of lines before the one that tells.
    """
    for name in ("asyncio", "absl"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def compile_cache() -> None:
    """Keep compiled programs in the user's cache: the second start is then quick."""
    jax.config.update("jax_compilation_cache_dir", str(cache.folder() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def keep_memory() -> bool:
    """Let glibc's allocator keep freed memory, and say whether it could be told.

    By default it gives large arrays back to the system when they are freed, and the next one's pages are faulted in and
    zeroed again, which can take longer than the arithmetic: 1,000 motions were encoded in 13 ms, and so in 3.4. At most
    2 GB are kept; for processes on a CPU, where arrays of some 10 MB come and go. Elsewhere it does nothing. What
    threads take for themselves is given back all the same: one arena for all of them would keep that too, but PyTorch
    then took up to five times as long.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return False
    return bool(mallopt(_MMAP_THRESHOLD, 1 << 30) and mallopt(_TRIM_THRESHOLD, KEPT))


def use_all_cores() -> None:
    """Make every core of the processor a device of JAX.

    `steps.vectorize_models` then shares its models among them, `parallel.data_parallel` its batch. Raises `RuntimeError`
    where JAX has been used before.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    jax.config.update("jax_num_cpu_devices", cores or 1)


def join_distributed(*, patience: int = 20) -> None:
    """Join the other processes of a job, before anything else with JAX: `jax.devices()` are then everybody's.

    By `jax.distributed.initialize`, with what JAX_COORDINATOR_ADDRESS (host:port of the first), JAX_NUM_PROCESSES and
    JAX_PROCESS_ID (from 0) say; without them JAX finds the others where Slurm, Open MPI and some more have started
    them. All have to come within five minutes, and JAX ends the process where one does not. One that has come and is
    not heard of for `patience` seconds is lost, and ends the others. Raises `ValueError` where variables are missing or
    name no host, port and numbers.
    """
    told = [os.environ[name] for name in _JOB if name in os.environ]
    if len(told) not in (0, len(_JOB)) or not all(number.isdigit() for number in told[1:]):
        raise ValueError(f"expected all of {', '.join(_JOB)}, the last two whole numbers, or none; got {told}")
    job = [told[0], *map(int, told[1:])] if told else []
    if told:
        _check_address(told[0])
        print(f"waiting for {told[1]} processes at {told[0]}", file=sys.stderr, flush=True)
    try:
        jax.distributed.initialize(*job, heartbeat_timeout_seconds=patience, shutdown_timeout_seconds=patience)
    except ValueError as error:
        if told:
            raise
        raise ValueError(f"no job to join ({error}): set {', '.join(_JOB)}") from error


def _check_address(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"JAX_COORDINATOR_ADDRESS: expected host:port, got {address}")
    try:
        socket.getaddrinfo(host.strip("[]"), int(port))
    except OSError as error:
        raise ValueError(f"JAX_COORDINATOR_ADDRESS: {host} is no known host ({error.strerror})") from error
