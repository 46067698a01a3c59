"""torchrun on several machines: here groups of processes with addresses of their own on this one."""

import os
import socket
import subprocess
import sys

import pytest
from ranks import joint_tensors
from test_faults import command

from voronerf.app.cli import main


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has more than one loopback address")
def test_two_machines_train_as_one_process(tmp_path):
    """Each finds the rendezvous at the address of the first; the run ends as that of one process, bit for bit."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    machines = []
    for number in range(2):
        address, out = f"127.0.0.{number + 1}", command(tmp_path / "run", "--territories", "2")
        where = ("--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--local-addr", address)
        torchrun = (sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1", *where)
        given = {**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
        machines.append(subprocess.Popen([*torchrun, "-m", "voronerf", *out], env=given, cwd=tmp_path))
    assert [machine.wait(timeout=120) for machine in machines] == [0, 0]
    assert main(command(tmp_path / "one", "--territories", "2")) == 0
    first, second = (joint_tensors(tmp_path / run) for run in ("run", "one"))
    assert first.keys() == second.keys() and all(first[name].equal(second[name]) for name in first)
