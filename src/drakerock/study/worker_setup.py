"""Loaded by Dask into each local worker before it starts."""

from __future__ import annotations

import logging
import signal
from typing import Any

from drakerock.logs import show_only_ours


def dask_setup(_worker: Any) -> None:
    """Ignore Ctrl-C, which a terminal sends to all its processes: the runner decides when workers stop."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    show_only_ours()
    # The runner says it, for all of them.
    logging.getLogger("drakerock.rocks.engine.compiling").setLevel(logging.ERROR)
    silence_closing()


def silence_closing() -> None:
    """Keep Dask from logging a traceback when a worker's connection closes before its last message is sent.

    Dask's own silencing ends while the cluster is closing.
    """
    logging.getLogger("distributed.batched").setLevel(logging.CRITICAL)
