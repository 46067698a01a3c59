"""Ranks in processes of this machine, with one thread each; torch is imported once for all of them."""

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

#: Seconds until ranks that hang are ended.
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


def start_ranks(function, each, folder, restarts=0, store=None):
    """The processes of ranks that call a function, each with arguments of its own; what they print comes into a folder.

    The store is that of earlier starts, as torchrun keeps it.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["voronerf.app.cli", "voronerf.app.train.loop"])
    store, size = store or new_store(), len(each)
    ranks = [
        context.Process(target=_rank, args=(rank, size, store.port, folder, restarts, function, given))
        for rank, given in enumerate(each)
    ]
    for rank in ranks:
        rank.start()
    ranks[0].store = store  # which lives as long
    return ranks


def said_by(ranks, folder):
    """What each rank has printed, once it has ended by itself."""
    said = [Path(folder) / f"rank-{rank}.txt" for rank in range(len(ranks))]
    return [path.read_text() if path.is_file() else "" for path in said]


def complaints(texts):
    """The lines that tell of an error."""
    return [line for text in texts for line in text.splitlines() if line.startswith("voronerf: error:")]


def on_ranks(function, *args, folder, size=2, each=None, restarts=0, store=None):
    """Calls a function on every rank, with arguments of its own where ``each`` has them.

    Returns the exit status of each rank, and what it printed.
    """
    ranks = start_ranks(function, each or [args] * size, Path(folder), restarts, store)
    for rank in ranks:
        rank.join(LIMIT)
        if rank.is_alive():
            rank.kill()
            rank.join()
    texts = said_by(ranks, folder)
    print(*texts, sep="\n", file=sys.stderr)  # where a test fails
    return [rank.exitcode for rank in ranks], texts


def network_files(run):
    """The files of the territories of the last checkpoint of a run."""
    path = checkpoint_path(run)
    return [path.with_name(name) for name in load_checkpoint(path).values["parts"][0]["networks"]]


def town_tensors(run):
    """The tensors of the last checkpoint of a run, and of the files of all territories."""
    found = [load_checkpoint(path).tensors for path in (checkpoint_path(run), *network_files(run))]
    return {f"{number}.{name}": tensor for number, part in enumerate(found) for name, tensor in part.items()}
