"""Runs ranks as processes of one thread each, forked from a server that has imported torch once."""

import contextlib
import io
import multiprocessing
import os
import sys
import traceback
from pathlib import Path

import torch
from torch.distributed import TCPStore

from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint

#: The seconds after which hanging ranks are killed.
LIMIT = 300


def _rank(rank, size, port, folder, restarts, function, args):
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(size), "MASTER_ADDR": "127.0.0.1"}
    os.environ |= {"MASTER_PORT": str(port), "TORCHELASTIC_USE_AGENT_STORE": "True"}
    os.environ |= {"TORCHELASTIC_RESTART_COUNT": str(restarts)}
    torch.set_num_threads(1)
    said, code = io.StringIO(), 1
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = function(*args) or 0
        except SystemExit as end:
            code = end.code
        except BaseException:
            traceback.print_exc()
    (folder / f"rank-{rank}.txt").write_text(said.getvalue())
    os._exit(code)


def new_store():
    return TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)


def start_ranks(function, arguments, folder, restarts=0, store=None):
    """Starts a process for each rank, which calls a function with the rank's arguments in ``arguments``.

    The ranks print to files in ``folder``. ``store`` stands for torchrun's store, which outlives restarts.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["voronerf.app.cli", "voronerf.app.train.loop"])
    store, size = store or new_store(), len(arguments)
    ranks = [
        context.Process(target=_rank, args=(rank, size, store.port, folder, restarts, function, args))
        for rank, args in enumerate(arguments)
    ]
    for rank in ranks:
        rank.start()
    ranks[0].store = store  # keeps the store alive
    return ranks


def said_by(ranks, folder):
    """Returns each rank's printed text, empty for a rank that was killed."""
    said = [Path(folder) / f"rank-{rank}.txt" for rank in range(len(ranks))]
    return [path.read_text() if path.is_file() else "" for path in said]


def complaints(texts):
    """Returns the error lines of the ranks' texts."""
    return [line for text in texts for line in text.splitlines() if line.startswith("voronerf: error:")]


def on_ranks(function, *args, folder, size=2, arguments=None, restarts=0, store=None):
    """Calls a function on every rank, with the same arguments or with the rank's arguments in ``arguments``.

    Returns (exit status of each rank, printed text of each rank).
    """
    ranks = start_ranks(function, arguments or [args] * size, Path(folder), restarts, store)
    for rank in ranks:
        rank.join(LIMIT)
        if rank.is_alive():
            rank.kill()
            rank.join()
    texts = said_by(ranks, folder)
    print(*texts, sep="\n", file=sys.stderr)  # pytest shows it if a test fails
    return [rank.exitcode for rank in ranks], texts


def network_files(run):
    """Returns the territories' network files of a run's last checkpoint."""
    path = checkpoint_path(run)
    return [path.with_name(name) for name in load_checkpoint(path).values["parts"][0]["networks"]]


def town_tensors(run):
    """Returns the tensors of a run's last checkpoint and of all its territories' files, by name."""
    parts = [load_checkpoint(path).tensors for path in (checkpoint_path(run), *network_files(run))]
    return {f"{number}.{name}": tensor for number, part in enumerate(parts) for name, tensor in part.items()}
