"""One field over several processes: `torchrun --nproc-per-node 2 examples/sharded_nerf.py`.

Around nerf-pytorch's `NeRF` of `nerf_pytorch.py`. Every process has rays of its own and the networks of its own cells.
"""

import torch
import torch.distributed as dist
import torch.nn.functional as F
from nerf_pytorch import NeRF, run_network

from voronerf import VoronoiRouter


def main() -> None:
    dist.init_process_group("gloo")  # "nccl" on GPUs
    rank, ranks = dist.get_rank(), dist.get_world_size()
    torch.manual_seed(rank)
    points = torch.rand(40 + 10 * rank, 16, 3) * 2 - 1  # each process may have another number of rays
    viewdirs = F.normalize(torch.randn(len(points), 3), dim=-1)

    model = NeRF(D=4, W=32, input_ch=63, input_ch_views=27, use_viewdirs=True)
    centres = torch.linspace(-1, 1, 4)[:, None] * torch.tensor([1.0, 0.5, 0.2])
    router = VoronoiRouter(model, centres, coords="first3", fuse=True)
    router.shard()  # from here on, each process has the parameters of its own cells
    optimizer = torch.optim.Adam(router.parameters(), lr=5e-4)

    def train(steps: int) -> None:
        for _ in range(steps):
            raw = run_network(points, viewdirs, router, netchunk=1 << 16)  # all processes make as many calls
            loss = (torch.sigmoid(raw[..., :3]) - 0.5).square().mean() / ranks  # the mean over all of them
            optimizer.zero_grad()
            loss.backward()
            router.sum_gradients()  # of parameters that cells share; here there are none
            optimizer.step()

    train(3)
    router.subdivide(2, optimizer=optimizer, points=points.view(-1, 3), weights=torch.ones(points[..., 0].numel()))
    train(3)

    expected = run_network(points, viewdirs, router, netchunk=1 << 16)
    state = router.gather_state_dict()  # of all cells, in the first process
    if rank == 0:
        alone = VoronoiRouter(model, centres, coords="first3", fuse=True)
        alone.load_state_dict(state)  # one process opens it
        torch.testing.assert_close(run_network(points, viewdirs, alone), expected)
        print(f"{alone.num_cells} cells on {ranks} ranks, of which rank 0 has {len(router.own_cells)}")
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
