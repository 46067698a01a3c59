"""Modules of public repositories: the repository, file, construction and call of each.

A key is "owner/name", followed by the folder of the import path, a colon and the file's dotted name.
"""

from __future__ import annotations

from types import SimpleNamespace as ns
from typing import Any

import torch
from torch import Tensor, nn

from ops.foreign_rows import Row, evaluated, inner, numbers, of, per_ray, uniform

Lead = tuple[int, ...]
RAYS = (70, 5)
BOX = [-1.0, -1.0, -1.0, 1.0, 1.0, 1.0]
SDF = {"skip_in": (2,), "multires": 6}
WIDE = [64] * 4


def in_a_dict(**sizes: int) -> Any:
    """Returns a function that makes a dict of named tensors."""
    return lambda lead: {name: uniform(lead, size) for name, size in sizes.items()}


def coords_of(key: str) -> Any:
    """Returns a function that takes the positions from an argument dict."""
    return lambda arguments, *_, **__: arguments[key]


def with_image(features: int) -> Any:
    """Returns a function that makes features whose last column is an image number."""
    return lambda lead: torch.cat([uniform(lead, features), numbers(100, 1)(lead)], -1)


class Unbatched(nn.Module):
    """A module that adds a leading batch dimension, [1, n, d]."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: Tensor) -> Tensor:
        return self.net(x[None])[0]


def pair(*sizes: int) -> Any:
    """Returns a function that makes a tuple of tensors."""
    return lambda lead: tuple(uniform(lead, size) for size in sizes)


class OfSensors(nn.Module):
    """A DeepONet whose trunk reads constant sensors."""

    def __init__(self, net: nn.Module, sensors: Tensor) -> None:
        super().__init__()
        self.net = net
        self.register_buffer("sensors", sensors)

    def forward(self, x: Tensor) -> Tensor:
        return self.net((x, self.sensors))


def deeponet(m: Any) -> nn.Module:
    return OfSensors(m.DeepONetCartesianProd([6, 32, 16], [2, 32, 16], "tanh", "Glorot normal"), torch.rand(20, 2))


def gpt(m: Any) -> nn.Module:
    dropouts = {"dropout": 0.0, "attn_pdrop": 0.0, "resid_pdrop": 0.0}
    return m.Block(ns(n_embd=24, n_head=4, bias=True, block_size=8, **dropouts))


def series(m: Any, **more: Any) -> nn.Module:
    """Makes a forecaster of series [n, 12, 3]."""
    sizes = {"seq_len": 12, "pred_len": 6, "enc_in": 3, "d_model": 16, "moving_avg": 5, "seg_len": 3, "e_layers": 2}
    return m.Model(ns(task_name="long_term_forecast", dropout=0.0, individual=False, **sizes), **more)


def nbeats(m: Any) -> nn.Module:
    sizes = {"backcast_size": 10, "forecast_size": 5}
    blocks = [m.NBeatsBlock(10, 15, m.GenericBasis(**sizes), 3, 32) for _ in range(3)]
    return m.NBeats(nn.ModuleList(blocks))


def tabular(m: Any) -> nn.Module:
    sizes = {"d_in": 6, "n_blocks": 2, "d_main": 16, "d_hidden": 24, "d_out": 2}
    return evaluated(m.ResNet.make_baseline(**sizes, dropout_first=0.0, dropout_second=0.0))


def drawn(module: nn.Module) -> nn.Module:
    """Draws the weights of a module that starts with zeros or with undefined numbers."""
    for parameter in module.parameters():
        nn.init.normal_(parameter, std=0.3)
    return module


SERIES, INNER = (of(12, 3), None, None, None), {"coords": inner}


def moment(_: Lead) -> Tensor:
    """Returns a time, which all samples have in common."""
    return torch.tensor(0.3)


def after_the_time(_: Tensor, x: Any) -> Tensor:
    """Returns the positions of a call whose first argument is the time."""
    return x[0] if isinstance(x, tuple) else x


def dreamfusion(m: Any) -> nn.Module:
    off = dict.fromkeys(("dmtet", "cuda_ray", "taichi_ray"), False)
    blob = {"blob_density": 5.0, "blob_radius": 0.2, "density_activation": "exp", "min_near": 0.01}
    return m.NeRFNetwork(ns(bound=1, bg_radius=0, density_thresh=10.0, **blob, **off))


LAMP = {"l": lambda _: torch.tensor([0.6, 0.0, 0.8]), "ratio": 0.5, "shading": "lambertian"}


def barf(**more: Any) -> Any:
    posenc = ns(L_3D=10, L_view=4, L_2D=8)
    layers = {"layers_feat": [None, 64, 64, 64, 64], "layers_rgb": [None, 32, 3], "layers": [None, 64, 64, 64, 3]}
    arch = ns(posenc=posenc, skip=[2], tf_init=True, density_activ="softplus", **layers)
    return ns(arch=arch, nerf=ns(view_dep=True, density_noise_reg=None), device="cpu", **more)


PLAIN, BARF = barf(barf_c2f=None), barf(barf_c2f=[0.1, 0.5])


def progressed(module: nn.Module) -> nn.Module:
    """Sets a BARF module to the middle of its schedule."""
    module.progress.data.fill_(0.3)
    return module


def direct_time(m: Any) -> nn.Module:
    embed = m.get_embedder(10, 3, 0)[0]
    return m.DirectTemporalNeRF(8, 64, 63, 27, 1, use_viewdirs=True, embed_fn=embed)


def unisurf(m: Any) -> nn.Module:
    sizes = {"num_layers": 4, "hidden_dim": 64, "octaves_pe": 6, "octaves_pe_views": 4, "skips": [2], "feat_size": 64}
    return m.NeuralNetwork({**sizes, "rescale": 1.0, "geometric_init": True})


def hexplane(m: Any) -> nn.Module:
    sizes = {"density_n_comp": [8] * 3, "app_n_comp": [8] * 3}
    return m.HexPlane(torch.tensor(BOX).view(2, 3), [16] * 3, "cpu", 8, [2.0, 6.0], density_featureC=32, **sizes)


def neuralangelo(m: Any, kind: str = "hashgrid") -> nn.Module:
    grid = ns(min_logres=4, max_logres=6, dict_size=10, dim=4, range=[-2, 2])
    encoding = ns(type=kind, levels=4, hashgrid=grid, coarse2fine=ns(enabled=False))
    mlp = ns(num_layers=1, hidden_dim=64, skip=[], activ="softplus", activ_params={"beta": 100})
    vars(mlp).update(geometric_init=True, weight_norm=True, out_bias=0.5, inside_out=False)
    found = m.NeuralSDF(ns(encoding=encoding, mlp=mlp, gradient=ns(mode="numerical", taps=4)))
    if kind == "hashgrid":
        found.set_normal_epsilon()
    return found


VIEW = ns(type="spherical", levels=3)


def neural_rgb(m: Any) -> nn.Module:
    mlp = ns(num_layers=4, hidden_dim=64, skip=[], activ="relu_", activ_params={}, weight_norm=True)
    return m.NeuralRGB(ns(mlp=mlp, mode="idr", encoding_view=VIEW), 64, ns(enabled=False))


def background(m: Any) -> nn.Module:
    mlp = ns(num_layers=8, hidden_dim=64, skip=[4], num_layers_rgb=2, hidden_dim_rgb=32, skip_rgb=[], activ="relu")
    vars(mlp).update(activ_params={}, activ_density="softplus", activ_density_params={})
    encoding = ns(type="fourier", levels=10)
    return m.BackgroundNeRF(ns(mlp=mlp, view_dep=True, encoding=encoding, encoding_view=VIEW), ns(enabled=False))


def zipnerf(m: Any) -> nn.Module:
    grid = {"grid_disired_resolution": 256, "grid_level_dim": 2, "warp_fn": None, "disable_density_normals": True}
    return m.MLP(bottleneck_width=64, net_width_viewdirs=64, **grid)


def tensorf(m: Any, name: str = "TensorVMSplit") -> nn.Module:
    sizes = {"density_n_comp": [8] * 3, "appearance_n_comp": [8] * 3, "featureC": 32, "shadingMode": "MLP_Fea"}
    return getattr(m, name)(torch.tensor(BOX).view(2, 3), [16] * 3, "cpu", **sizes)


def kplanes(m: Any, linear: bool = False) -> nn.Module:
    grid = {"grid_dimensions": 2, "input_coordinate_dim": 3, "output_coordinate_dim": 8, "resolution": [16] * 3}
    box = torch.tensor(BOX).view(2, 3)
    layers = 1 if linear else None
    return m.KPlaneField(box, [grid], True, [1, 2], False, 0, None, torch.exp, linear, layers, None)


def plane_density(m: Any) -> nn.Module:
    return m.KPlaneDensityField(torch.tensor(BOX).view(2, 3), [16] * 3, 3, 8, torch.exp, linear_decoder=False)


def octree(m: Any) -> nn.Module:
    sizes = {"feature_dim": 8, "feature_size": 4, "hidden_dim": 64, "num_lods": 3, "base_lod": 2}
    off = {"pos_invariant": False, "interpolate": None, "joint_decoder": False, "pos_enc": False, "ff_dim": -1}
    return m.OctreeSDF(ns(**sizes, **off)).eval()


def overfit(m: Any) -> nn.Module:
    return m.OverfitSDF(ns(pos_enc=True, ff_dim=-1, num_layers=4, hidden_dim=64, skip=None))


def joined(m: Any) -> nn.Module:
    points, views = m.Embedder(3, 9, 10), m.Embedder(3, 3, 4)
    return m.Joiner(points, views, m.NeRF(8, 64, points.out_dim, views.out_dim, use_viewdirs=True))


def offsets(m: Any) -> nn.Module:
    encoding = m.Embedder(4, 5, 6)
    return m.OffsetNet(encoding, m.NeRF(4, 64, encoding.out_dim, 0, 3, scale=0.1, scale_type="tanh"))


def ibrnet(m: Any) -> nn.Module:
    m.IBRNet.posenc = lambda self, d_hid, n_samples: torch.randn(1, n_samples, d_hid)  # the original uses CUDA
    return m.IBRNet(ns(anti_alias_pooling=1), in_feat_ch=32, n_samples=RAYS[1])


def bending(m: Any) -> nn.Module:
    return m.ray_bending(63, 32, "simple_neural", m.get_embedder(10, 0)[0])


def masked(lead: Lead) -> Tensor:
    return torch.rand(lead) < 0.5


def instant_nsr(name: str, *inputs: int) -> Row:
    return Row(f"NeRFNetwork.{name}", lambda m: m.NeRFNetwork(), inputs, method=name, keywords={"bound": 1.0})


def inr(m: Any, **more: Any) -> nn.Module:
    return m.INR(3, 64, 2, 3, **more)


def single(kind: str = "sine", mode: str = "mlp") -> Any:
    return lambda m: m.SingleBVPNet(1, kind, 3, mode, hidden_features=64)


def bacon(name: str, **more: Any) -> Any:
    return lambda m: getattr(m, name)(3, 64, 4, 4, frequency=(32, 32, 32), **more)


def implicit(m: Any) -> nn.Module:
    """Makes the signed distance network of VolSDF and MonoSDF."""
    return m.ImplicitNetwork(64, 3.0, 3, 1, WIDE, bias=0.6, **SDF)


def rendering(m: Any) -> nn.Module:
    """Makes the colour network of IDR and its descendants."""
    return m.RenderingNetwork(64, "idr", 9, 3, WIDE, multires_view=4)


NORMED = {"norm_layers": (0, 1, 2, 3)}
BEHIND = {"coords": lambda x: x[:, -3:]}  # positions behind a code


def decoder(m: Any, **more: Any) -> nn.Module:
    """Makes the decoder of DeepSDF and SAL."""
    return m.Decoder(32, WIDE, latent_in=[2], **more)


def vanilla(m: Any) -> nn.Module:
    return m.VanillaNeRFRadianceField(8, 64, 4, 1, 32)


def skips(m: Any, **more: Any) -> nn.Module:
    """Makes the network of nerf-pytorch and its descendants."""
    return m.NeRF(8, 64, 63, 27, use_viewdirs=True, **more)


BVP, TIME = {"coords": coords_of("coords")}, lambda _: torch.tensor([[0.3]])
POINTS = in_a_dict(coords=3)
MEGA = {"pos_xyz_dim": 10, "pos_dir_dim": 4, "layers": 8, "skip_layers": [4], "layer_dim": 64, "rgb_dim": 3}


def mega(appearance: int) -> Any:
    sizes = {**MEGA, "appearance_dim": appearance, "appearance_count": 100, "affine_appearance": False, "xyz_dim": 3}
    return lambda m: m.NeRF(**sizes, sigma_activation=m.ShiftedSoftplus())


PUBLIC: dict[str, list[Row]] = {
    "yenchenlin/nerf-pytorch:run_nerf_helpers": [
        Row("NeRF", skips, (90,)),
        Row("NeRF without view", lambda m: m.NeRF(8, 64, 63, 0), (63,)),
    ],
    "krrish94/nerf-pytorch:nerf.models": [
        Row("VeryTinyNeRFModel", lambda m: m.VeryTinyNeRFModel(64), (78,)),
        Row("MultiHeadNeRFModel", lambda m: m.MultiHeadNeRFModel(64), (78,)),
        Row("FlexibleNeRFModel", lambda m: m.FlexibleNeRFModel(4, 64), (66,)),
        Row("ReplicateNeRFModel", lambda m: m.ReplicateNeRFModel(64), (66,)),
    ],
    "kwea123/nerf_pl:models.nerf": [
        Row("NeRF", lambda m: m.NeRF(W=64), (90,)),
        Row("NeRF sigma_only", lambda m: m.NeRF(W=64), (63,), keywords={"sigma_only": True}),
    ],
    "hjxwhy/mipnerf_pl:models.mip_nerf": [
        Row("MLP", lambda m: m.MLP(8, 64, 1, 32, 4, 3, 1, "relu", 96, 27), (96, per_ray(27)), lead=RAYS)
    ],
    "nerfstudio-project/nerfacc/examples:radiance_fields.mlp": [
        Row("VanillaNeRFRadianceField", vanilla, (3, 3)),
        Row("VanillaNeRFRadianceField.query_density", vanilla, (3,), method="query_density"),
        Row("TNeRFRadianceField", lambda m: m.TNeRFRadianceField(), (3, 1, 3)),
        Row("NDRTNeRFRadianceField", lambda m: m.NDRTNeRFRadianceField(), (3, 1, 3)),
    ],
    "nerfstudio-project/nerfacc/examples:radiance_fields.ngp": [
        Row("NGPRadianceField (tcnn in torch)", lambda m: m.NGPRadianceField(BOX, n_levels=4), (3, 3)),
        Row("NGPDensityField (tcnn in torch)", lambda m: m.NGPDensityField(BOX), (3,)),
    ],
    "cmusatyalab/mega-nerf:mega_nerf.models.nerf": [
        Row("NeRF with appearance", mega(48), (with_image(6),)),
        Row("NeRF", mega(0), (6,)),
        Row("NeRF sigma_only", mega(0), (3,), keywords={"sigma_only": True}),
    ],
    "lucidrains/siren-pytorch:siren_pytorch.siren_pytorch": [
        Row("SirenNet", lambda m: m.SirenNet(3, 64, 4, 4), (3,), second=True)
    ],
    "vsitzmann/siren:modules": [
        *(
            Row(f"SingleBVPNet {kind}", single(kind), (POINTS,), **BVP)
            for kind in ("sine", "relu", "tanh", "softplus", "sigmoid")
        ),
        Row("SingleBVPNet nerf", single("relu", "nerf"), (POINTS,), **BVP),
        Row("PINNet", lambda m: m.PINNet(1, "tanh", 3), (POINTS,), **BVP),
        Row("FCBlock", lambda m: m.FCBlock(3, 2, 3, 64, True, "sine"), (3,), second=True),
        Row("SingleBVPNet itself", single(), (POINTS,), **BVP),
    ],
    "Blealtan/efficient-kan/src:efficient_kan.kan": [
        Row("KAN", lambda m: m.KAN([3, 32, 32, 4]), (3,)),
        Row("KANLinear", lambda m: m.KANLinear(3, 16), (3,)),
    ],
    "ZiyaoLi/fast-kan:fastkan.fastkan": [Row("FastKAN", lambda m: m.FastKAN([3, 32, 32, 4]), (3,))],
    "ashawkey/stable-dreamfusion:nerf.network": [
        Row("NeRFNetwork (frequency)", dreamfusion, (3, 3)),
        Row("NeRFNetwork.density (frequency)", dreamfusion, (3,), method="density"),
        Row("NeRFNetwork lambertian", dreamfusion, (3, 3), keywords=LAMP, options={"shared": ["l"]}),
    ],
    "ashawkey/stable-dreamfusion:nerf.network_grid": [Row("NeRFNetwork (grid)", dreamfusion, (3, 3))],
    "sxyu/pixel-nerf/src:model.resnetfc": [
        Row("ResnetFC", lambda m: m.ResnetFC(42, d_hidden=64), (42,)),
        Row(
            "ResnetFC spade, softplus",
            lambda m: m.ResnetFC(39, d_hidden=64, d_latent=32, beta=100.0, use_spade=True),
            (71,),
            coords=lambda zx, **_: zx[..., 32:35],
        ),
    ],
    "sxyu/pixel-nerf/src:model.mlp": [
        Row("ImplicitNet", lambda m: m.ImplicitNet(3, WIDE, skip_in=[2], beta=100.0), (3,))
    ],
    "marcoamonteiro/pi-GAN:siren.siren": [
        Row("TALLSIREN", lambda m: m.TALLSIREN(3, 32, 64), (3, per_ray(32), 3), lead=RAYS),
        Row("SPATIALSIRENBASELINE", lambda m: m.SPATIALSIRENBASELINE(3, 32, 64), (3, per_ray(32), 3), lead=RAYS),
        Row("FiLMLayer", lambda m: m.FiLMLayer(3, 64), (3, per_ray(64), per_ray(64)), lead=RAYS),
        Row("CustomMappingNetwork", lambda m: m.CustomMappingNetwork(32, 64, 128), (32,)),
    ],
    "Totoro97/NeuS:models.fields": [
        Row("SDFNetwork", lambda m: m.SDFNetwork(3, 65, 64, 4, **SDF), (3,), second=True),
        Row("SDFNetwork.gradient", lambda m: m.SDFNetwork(3, 65, 64, 4, **SDF), (3,), method="gradient"),
        Row("RenderingNetwork", lambda m: m.RenderingNetwork(64, "idr", 9, 3, 64, 4, multires_view=4), (3, 3, 3, 64)),
        Row("NeRF (background)", lambda m: m.NeRF(8, 64, 4, 3, 10, 4, use_viewdirs=True), (4, 3)),
    ],
    "lioryariv/volsdf/code:model.network": [
        Row("ImplicitNetwork", implicit, (3,), second=True),
        Row("ImplicitNetwork.get_outputs", implicit, (3,), method="get_outputs"),
        Row("ImplicitNetwork.get_sdf_vals", implicit, (3,), method="get_sdf_vals"),
        Row("RenderingNetwork", rendering, (3, 3, 3, 64)),
    ],
    "lioryariv/idr/code:model.implicit_differentiable_renderer": [
        Row("ImplicitNetwork", lambda m: m.ImplicitNetwork(64, 3, 1, WIDE, bias=0.6, **SDF), (3,), second=True),
        Row("RenderingNetwork", rendering, (3, 3, 3, 64)),
    ],
    "autonomousvision/monosdf/code:model.network": [
        Row("ImplicitNetwork", implicit, (3,), second=True),
        Row(
            "ImplicitNetworkGrid",
            lambda m: m.ImplicitNetworkGrid(64, 0.0, 3, 1, [64, 64], multires=6, num_levels=4, end_size=128),
            (3,),
        ),
        Row("RenderingNetwork", rendering, (3, 3, 3, 64, None)),
    ],
    "ActiveVisionLab/nerfmm:models.nerf_models": [
        Row("OfficialNerf", lambda m: m.OfficialNerf(63, 27, 64), (63, 27), lead=(70, 2, 3))
    ],
    "chenhsuanlin/bundle-adjusting-NeRF:model.barf": [
        Row("NeRF (BARF)", lambda m: progressed(m.NeRF(BARF)), (BARF, 3, 3))
    ],
    "chenhsuanlin/bundle-adjusting-NeRF:model.nerf": [Row("NeRF", lambda m: m.NeRF(PLAIN), (PLAIN, 3, 3))],
    "chenhsuanlin/bundle-adjusting-NeRF:model.planar": [
        Row("NeuralImageFunction", lambda m: progressed(m.NeuralImageFunction(BARF)), (BARF, 2))
    ],
    "albertpumarola/D-NeRF:run_dnerf_helpers": [
        Row("DirectTemporalNeRF", direct_time, (90, lambda lead: [torch.full((*lead, 1), 0.3)])),
        Row(
            "NeRFOriginal",
            lambda m: m.NeRFOriginal(8, 64, 63, 27, use_viewdirs=True),
            (90, lambda lead: [uniform(lead, 1)]),
        ),
    ],
    "hustvl/TiNeuVox:lib.tineuvox": [
        Row("Deformation", lambda m: m.Deformation(4, 64, 27, 3, 9), (27, 9)),
        Row("RGBNet", lambda m: m.RGBNet(W=64, h_ch=64, views_ch=33), (64, 33)),
    ],
    "computational-imaging/bacon:modules": [
        Row("BACON", bacon("BACON"), (POINTS,), **BVP),
        Row("MultiscaleBACON", bacon("MultiscaleBACON"), (POINTS,), **BVP),
        Row("CoordinateNet", lambda m: m.CoordinateNet(4, "relu", 3, 64), (POINTS,), **BVP),
        Row(
            "RadianceNet",
            lambda m: m.RadianceNet(63 + 54, 4, 64),
            (in_a_dict(ray_samples=3, ray_orientations=6),),
            coords=coords_of("ray_samples"),
            lead=RAYS,
        ),
    ],
    "vishwa91/wire:modules.wire": [
        Row("INR wire", inr, (3,)),
        Row("RealGaborLayer", lambda m: m.RealGaborLayer(3, 64), (3,)),
        Row("ComplexGaborLayer", lambda m: m.ComplexGaborLayer(3, 64, is_first=True), (3,)),
    ],
    "vishwa91/wire:modules.wire2d": [Row("INR wire2d", inr, (3,))],
    "vishwa91/wire:modules.gauss": [Row("INR gauss", inr, (3,))],
    "vishwa91/wire:modules.relu": [Row("INR relu", inr, (3,))],
    "vishwa91/wire:modules.siren": [Row("INR siren", inr, (3,))],
    "vishwa91/wire:modules.mfn": [Row("INR mfn", lambda m: Unbatched(inr(m)), (3,))],
    "autonomousvision/unisurf:model.network": [
        Row("NeuralNetwork", unisurf, (3, 3), keywords={"return_addocc": True}),
        Row("NeuralNetwork occupancy", unisurf, (3,), keywords={"only_occupancy": True}, second=True),
    ],
    "Caoang327/HexPlane:hexplane.model.mlp": [
        Row("General_MLP", lambda m: m.General_MLP(27, 3, featureC=64, zero_init=False), (3, 3, 27, 1))
    ],
    "Caoang327/HexPlane:hexplane.model.HexPlane": [
        Row("HexPlane.compute_appfeature", hexplane, (3, 1), method="compute_appfeature"),
        Row("HexPlane.compute_densityfeature", hexplane, (3, 1), method="compute_densityfeature"),
    ],
    "Jiawei-Yang/FreeNeRF/DietNeRF-pytorch/dietnerf:run_nerf_helpers": [Row("NeRF (DietNeRF)", skips, (90,))],
    "NVlabs/neuralangelo:projects.neuralangelo.utils.modules": [
        Row("NeuralSDF (hashgrid)", neuralangelo, (3,)),
        Row("NeuralSDF.compute_gradients", neuralangelo, (3,), method="compute_gradients"),
        Row("NeuralSDF (fourier)", lambda m: neuralangelo(m, "fourier"), (3,), second=True),
        Row("NeuralRGB", neural_rgb, (3, 3, 3, 64, None)),
        Row("BackgroundNeRF", background, (3, 3, None)),
    ],
    "SuLvXiangXin/zipnerf-pytorch:internal.models": [
        Row(
            "MLP",
            zipnerf,
            (False, of(6, 3), lambda lead: torch.rand(*lead, 6), per_ray(3)),
            coords=lambda rand, means, *_, **__: means.mean(-2),
            lead=RAYS,
        )
    ],
    "amosgropp/IGR/code:model.network": [
        Row("ImplicitNet", lambda m: m.ImplicitNet(3, WIDE, skip_in=[2]), (3,), second=True)
    ],
    "facebookresearch/DeepSDF:networks.deep_sdf_decoder": [
        Row("Decoder", lambda m: decoder(m, **NORMED, weight_norm=True), (35,), **BEHIND),
        Row("Decoder, LayerNorm", lambda m: decoder(m, **NORMED), (35,), **BEHIND),
    ],
    "matanatz/SAL/code:model.network": [
        Row("Decoder", lambda m: decoder(m, dropout=(), activation="torch.nn.Tanh"), (35,), **BEHIND)
    ],
    "apchenstu/TensoRF:models.tensorBase": [
        Row("MLPRender_Fea", lambda m: m.MLPRender_Fea(27, featureC=64), (3, 3, 27)),
        # The first layer has three more inputs.
        Row("MLPRender_PE", lambda m: m.MLPRender_PE(27, featureC=64), (3, 3, 30)),
        Row("MLPRender", lambda m: m.MLPRender(27, featureC=64), (3, 3, 27)),
    ],
    "apchenstu/TensoRF:models.tensoRF": [
        Row("TensorVMSplit.compute_appfeature", tensorf, (3,), method="compute_appfeature"),
        Row("TensorCP.compute_appfeature", lambda m: tensorf(m, "TensorCP"), (3,), method="compute_appfeature"),
        Row("TensorVMSplit.compute_densityfeature", tensorf, (3,), method="compute_densityfeature"),
    ],
    "apple/ml-neuman:models.vanilla": [Row("Joiner(NeRF)", joined, (3, 3)), Row("OffsetNet", offsets, (4,))],
    "ashawkey/torch-ngp:nerf.network": [
        Row("NeRFNetwork", lambda m: m.NeRFNetwork(), (3, 3)),
        Row("NeRFNetwork (frequency)", lambda m: m.NeRFNetwork("frequency", "frequency"), (3, 3)),
        Row("NeRFNetwork.density", lambda m: m.NeRFNetwork(), (3,), method="density"),
        Row(
            "NeRFNetwork.color with mask",
            lambda m: m.NeRFNetwork(),
            (3, 3),
            method="color",
            keywords={"mask": masked, "geo_feat": 15},
        ),
    ],
    "ashawkey/torch-ngp:dnerf.network": [
        Row("NeRFNetwork (D-NeRF)", lambda m: m.NeRFNetwork(hidden_dim_deform=64), (3, 3, TIME)),
        Row("NeRFNetwork (D-NeRF, frequency)", lambda m: m.NeRFNetwork("frequency", "frequency"), (3, 3, TIME)),
    ],
    "ashawkey/torch-ngp:dnerf.network_basis": [
        Row("NeRFNetwork (D-NeRF basis)", lambda m: m.NeRFNetwork(), (3, 3, TIME))
    ],
    "ashawkey/torch-ngp:dnerf.network_hyper": [
        Row("NeRFNetwork (D-NeRF hyper)", lambda m: m.NeRFNetwork(), (3, 3, TIME))
    ],
    "ashawkey/torch-ngp:sdf.netowrk": [Row("SDFNetwork", lambda m: m.SDFNetwork(), (3,))],
    "ashawkey/torch-ngp:tensoRF.network": [
        Row("NeRFNetwork (TensoRF)", lambda m: m.NeRFNetwork([16] * 3, [4] * 3, [8] * 3, hidden_dim=64), (3, 3))
    ],
    "ashawkey/torch-ngp:tensoRF.network_cp": [
        Row("NeRFNetwork (TensoRF CP)", lambda m: m.NeRFNetwork([16] * 3, [8] * 3, [16] * 3, hidden_dim=64), (3, 3))
    ],
    "autonomousvision/occupancy_networks:im2mesh.onet.models.decoder": [
        Row("Decoder", lambda m: m.Decoder(3, 0, 0, 64), (3, None), lead=RAYS),
        Row("Decoder with codes", lambda m: m.Decoder(3, 16, 16, 64), (3, per_ray(16), per_ray(16)), lead=RAYS),
    ],
    "autonomousvision/occupancy_networks:im2mesh.layers": [Row("ResnetBlockFC", lambda m: m.ResnetBlockFC(64), (64,))],
    "creiser/kilonerf:run_nerf_helpers": [Row("NeRF", skips, (90,))],
    "facebookresearch/nonrigid_nerf:run_nerf_helpers": [
        Row("ray_bending", bending, (63, 32)),
        Row("NeRF", skips, (90,)),
    ],
    "gaochen315/DynamicNeRF:run_nerf_helpers": [
        Row("NeRF_d", lambda m: m.NeRF_d(8, 64, 63, 27), (90,)),
        Row("NeRF_s", lambda m: m.NeRF_s(8, 64, 63, 27), (90,)),
    ],
    "zhengqili/Neural-Scene-Flow-Fields/nsff_exp:run_nerf_helpers": [
        Row("NeRF (dynamic)", lambda m: m.NeRF(8, 64, 63, 27), (90,)),
        Row("Rigid_NeRF", lambda m: m.Rigid_NeRF(8, 64, 63, 27), (90,)),
    ],
    "kwea123/ngp_pl:models.networks": [Row("NGP (tcnn in torch)", lambda m: m.NGP(0.5), (3, 3))],
    "nv-tlabs/nglod/sdf-net:lib.models.OverfitSDF": [Row("OverfitSDF", overfit, (3,))],
    "nv-tlabs/nglod/sdf-net:lib.models.OctreeSDF": [Row("OctreeSDF", octree, (3,))],
    "sarafridov/K-Planes:plenoxels.models.kplane_field": [
        Row("KPlaneField", kplanes, (3, per_ray(3)), lead=RAYS, options={"share": ["grids.*"]}),
        Row("KPlaneField linear decoder", lambda m: kplanes(m, True), (3, per_ray(3)), lead=RAYS),
        Row("KPlaneField, planes per cell", kplanes, (3, per_ray(3)), lead=RAYS),
    ],
    "sarafridov/K-Planes:plenoxels.models.density_fields": [
        Row("KPlaneDensityField.get_density", plane_density, (3,), method="get_density", lead=RAYS)
    ],
    "yashbhalgat/HashNeRF-pytorch:run_nerf_helpers": [
        Row("NeRFSmall", lambda m: m.NeRFSmall(input_ch=32, input_ch_views=16), (48,))
    ],
    "ykasten/layered-neural-atlases:implicit_neural_networks": [
        Row("IMLP", lambda m: m.IMLP(3, 2, 64), (3,)),
        Row("IMLP softmax", lambda m: m.IMLP(3, 2, 64, use_tanh=False, apply_softmax=True), (3,)),
    ],
    "zhaofuq/Instant-NSR:nerf.network_sdf": [
        instant_nsr("forward_sdf", 3),
        instant_nsr("gradient", 3),
        instant_nsr("forward_color", 3, 3, 3, 15),
    ],
    "zju3dv/NeuralRecon-W:models.neuconw": [
        Row("SDFNetwork", lambda m: m.SDFNetwork(3, 65, 64, 4, **SDF), (3,), second=True),
        Row(
            "RenderingNetwork",
            lambda m: m.RenderingNetwork(64, "idr", 9, 3, 64, 4, head_channels=32),
            (3, 3, 3, 64, 48),
        ),
    ],
    "zju3dv/NeuralRecon-W:models.nerf": [
        Row("NeRF", lambda m: m.NeRF(8, 64, 4, 3, 10, 4, use_viewdirs=True), (4, 3, 48))
    ],
    "googleinterns/IBRNet:ibrnet.mlp_network": [
        Row(
            "IBRNet",
            ibrnet,
            (of(3, 35), of(3, 4), lambda lead: torch.ones(*lead, 3, 1)),
            coords=lambda features, *_, **__: features[..., 0, :3],
            lead=RAYS,
        )
    ],
    "shenweichen/DeepCTR-Torch:deepctr_torch.layers.interaction": [
        Row("InteractingLayer", lambda m: m.InteractingLayer(8), (of(5, 8),), **INNER),
        Row("InteractingLayer, 4 heads", lambda m: m.InteractingLayer(8, 4, scaling=True), (of(3, 8),), **INNER),
        Row("CrossNet", lambda m: m.CrossNet(9), (9,)),
        Row("CrossNet, matrix", lambda m: m.CrossNet(9, parameterization="matrix"), (9,)),
        Row("BilinearInteraction", lambda m: m.BilinearInteraction(4, 6), (of(4, 6),), **INNER),
        Row("SENETLayer", lambda m: m.SENETLayer(6), (of(6, 5),), **INNER),
        Row("CIN", lambda m: m.CIN(4, (8, 8)), (of(4, 6),), **INNER),
        Row(
            "AFMLayer",
            lambda m: m.AFMLayer(6),
            (lambda lead: list(uniform(lead, 4, 6).split(1, 1)),),
            coords=lambda x: x[0][:, 0, :3],
        ),
    ],
    "shenweichen/DeepCTR-Torch:deepctr_torch.layers.core": [
        Row("DNN, BatchNorm in eval", lambda m: evaluated(m.DNN(9, [32, 16], use_bn=True, init_std=0.3)), (9,))
    ],
    "shenweichen/DeepCTR-Torch:deepctr_torch.layers.activation": [
        Row("Dice in eval", lambda m: evaluated(m.Dice(9)), (9,))
    ],
    "shenweichen/DeepCTR-Torch:deepctr_torch.layers.sequence": [
        Row("AUGRUCell", lambda m: drawn(m.AUGRUCell(6, 8)), (6, 8, 1))
    ],
    "rtqichen/ffjord/lib/layers:diffeq_layers.basic": [
        Row("ConcatSquashLinear", lambda m: m.ConcatSquashLinear(3, 16), (moment, 3), coords=after_the_time),
        Row("HyperLinear", lambda m: drawn(m.HyperLinear(3, 16)), (moment, 3), coords=after_the_time),
    ],
    "rtqichen/ffjord/lib:layers.odefunc": [
        Row(
            "ODEnet, concatsquash",
            lambda m: m.ODEnet((32, 32), (3,), None, False, "concatsquash"),
            (moment, 3),
            coords=after_the_time,
        )
    ],
    "rtqichen/ffjord/lib/layers:coupling": [Row("CouplingLayer", lambda m: m.CouplingLayer(4), (4,))],
    "rtqichen/torchdiffeq/examples:cnf": [
        Row("CNF", lambda m: m.CNF(2, 16, 8), (moment, pair(2, 1)), coords=after_the_time)
    ],
    "bayesiains/nflows:nflows.transforms.made": [
        Row("MADE", lambda m: m.MADE(4, 16), (4,)),
        Row("MADE with context", lambda m: m.MADE(4, 16, 3), (4, 3)),
        Row("MADE, BatchNorm in eval", lambda m: evaluated(m.MADE(4, 16, use_batch_norm=True)), (4,)),
        Row("MaskedLinear", lambda m: m.MaskedLinear(torch.arange(1, 5), 8, 4, False, False), (4,)),
    ],
    "bayesiains/nflows:nflows.nn.nets.resnet": [
        Row("ResidualNet with context", lambda m: m.ResidualNet(4, 6, 24, 3), (4, 3)),
        Row("ResidualNet, BatchNorm in eval", lambda m: evaluated(m.ResidualNet(4, 6, 24, use_batch_norm=True)), (4,)),
    ],
    "ikostrikov/pytorch-flows:flows": [
        Row("MADE", lambda m: m.MADE(4, 16), (4,)),
        Row("FlowSequential in eval", lambda m: m.FlowSequential(m.MADE(4, 16), m.BatchNormFlow(4)).eval(), (4,)),
        Row("LUInvertibleMM", lambda m: m.LUInvertibleMM(4), (4,)),
        Row("InvertibleMM", lambda m: m.InvertibleMM(4), (4,)),
        Row(
            "FlowSequential",
            lambda m: m.FlowSequential(m.MADE(4, 16), m.Reverse(4), m.CouplingLayer(4, 16, torch.arange(4.0) % 2)),
            (4,),
        ),
    ],
    "karpathy/pytorch-normalizing-flows:nflib.flows": [
        Row("SlowMAF", lambda m: m.SlowMAF(4, True), (4,)),
        Row("MAF", lambda m: m.MAF(4, True), (4,)),
        Row("AffineHalfFlow", lambda m: m.AffineHalfFlow(4, False), (4,)),
    ],
    "philipperemy/n-beats:nbeats_pytorch.model": [
        Row("NBeatsNet", lambda m: m.NBeatsNet(hidden_layer_units=32), (10,)),
        Row("NBeatsNet, generic", lambda m: m.NBeatsNet(stack_types=("generic",) * 2, hidden_layer_units=32), (10,)),
        Row("GenericBlock", lambda m: m.GenericBlock(32, 4, "cpu"), (10,)),
    ],
    "ServiceNow/N-BEATS:models.nbeats": [Row("NBeats", nbeats, (10, lambda lead: torch.ones(*lead, 10)))],
    "karpathy/nanoGPT:model": [Row("Block", gpt, (of(6, 24),), **INNER), Row("MLP", lambda m: gpt(m).mlp, (24,))],
    "karpathy/minGPT:mingpt.model": [
        Row("Block", gpt, (of(6, 24),), **INNER),
        Row("CausalSelfAttention", lambda m: gpt(m).attn, (of(6, 24),), **INNER),
    ],
    "jadore801120/attention-is-all-you-need-pytorch:transformer.SubLayers": [
        Row(
            "MultiHeadAttention",
            lambda m: m.MultiHeadAttention(2, 16, 8, 8, 0.0).eval(),
            (of(5, 16), of(7, 16), of(7, 16)),
            **INNER,
        )
    ],
    "juho-lee/set_transformer:modules": [
        Row("SAB", lambda m: m.SAB(3, 16, 4, ln=True), (of(5, 3),), **INNER),
        Row("ISAB", lambda m: m.ISAB(3, 16, 2, 6), (of(5, 3),), **INNER),
        Row("PMA", lambda m: m.PMA(16, 4, 2), (of(5, 16),), **INNER),
    ],
    "manzilzaheer/DeepSets/PointClouds:classifier": [
        Row("PermEqui2_max", lambda m: m.PermEqui2_max(3, 16), (of(6, 3),), **INNER)
    ],
    "thuml/Time-Series-Library:models.SegRNN": [Row("SegRNN", series, SERIES, **INNER)],
    "thuml/Time-Series-Library:models.DLinear": [
        Row("DLinear", series, SERIES, **INNER),
        Row("DLinear, individual", lambda m: series(m, individual=True), SERIES, **INNER),
    ],
    "thuml/Time-Series-Library:models.TSMixer": [Row("TSMixer", series, SERIES, **INNER)],
    "thuml/Time-Series-Library:models.TiDE": [Row("ResBlock", lambda m: m.ResBlock(9, 16, 8, 0.0), (9,))],
    "cure-lab/LTSF-Linear:models.NLinear": [Row("NLinear", series, (of(12, 3),), **INNER)],
    "sktime/pytorch-forecasting/pytorch_forecasting/models/temporal_fusion_transformer:sub_modules": [
        Row("GatedResidualNetwork", lambda m: m.GatedResidualNetwork(6, 16, 8, 0.0, context_size=5), (6, 5))
    ],
    "locuslab/TCN:TCN.tcn": [
        Row("TemporalConvNet", lambda m: m.TemporalConvNet(3, [8, 8]).eval(), (of(3, 12),), **INNER)
    ],
    "ndrplz/ConvLSTM_pytorch:convlstm": [
        Row("ConvLSTM", lambda m: m.ConvLSTM(2, 4, (3, 3), 1, batch_first=True), (of(3, 2, 5, 5),), **INNER)
    ],
    "raminmh/CfC:torch_cfc": [
        Row(
            "CfcCell",
            lambda m: m.CfcCell(4, 8, {"backbone_activation": "lecun", "backbone_units": 16, "backbone_layers": 2}),
            (4, 8, 1),
        ),
        Row("LSTMCell", lambda m: m.LSTMCell(4, 8), (4, pair(8, 8))),
    ],
    "mlech26l/ncps:ncps.torch.cfc": [
        Row("CfC", lambda m: m.CfC(4, 8, proj_size=2, backbone_units=16), (of(5, 4),), **INNER)
    ],
    "ctallec/world-models:models.mdrnn": [Row("MDRNNCell", lambda m: m.MDRNNCell(8, 3, 16, 2), (3, 8, pair(16, 16)))],
    "ikostrikov/pytorch-a2c-ppo-acktr-gail:a2c_ppo_acktr.model": [
        Row("MLPBase", lambda m: m.MLPBase(6, hidden_size=32), (6, 1, 1)),
        Row("MLPBase, recurrent", lambda m: m.MLPBase(6, True, 32), (6, 32, 1)),
    ],
    "sfujim/TD3:TD3": [
        Row("Critic", lambda m: m.Critic(8, 3), (8, 3)),
        Row("Critic.Q1", lambda m: m.Critic(8, 3), (8, 3), method="Q1"),
    ],
    "pranz24/pytorch-soft-actor-critic:model": [Row("GaussianPolicy", lambda m: m.GaussianPolicy(8, 3, 32), (8,))],
    "openai/spinningup/spinup/algos/pytorch/td3:core": [
        Row("MLPQFunction", lambda m: m.MLPQFunction(8, 3, (32, 32), nn.ReLU), (8, 3))
    ],
    "Kaixhin/Rainbow:model": [Row("NoisyLinear", lambda m: m.NoisyLinear(8, 4), (8,))],
    "rixwew/pytorch-fm:torchfm.layer": [
        Row("MultiLayerPerceptron in eval", lambda m: evaluated(m.MultiLayerPerceptron(9, [32, 16], 0.2)), (9,)),
        Row("OuterProductNetwork", lambda m: m.OuterProductNetwork(4, 5), (of(4, 5),), **INNER),
        Row("CrossNetwork", lambda m: m.CrossNetwork(9, 3), (9,)),
        Row(
            "AttentionalFactorizationMachine",
            lambda m: m.AttentionalFactorizationMachine(5, 8, (0.0, 0.0)),
            (of(4, 5),),
            **INNER,
        ),
        Row("CompressedInteractionNetwork", lambda m: m.CompressedInteractionNetwork(4, (8, 8)), (of(4, 6),), **INNER),
    ],
    "yandex-research/rtdl:rtdl.modules": [
        Row("NumericalFeatureTokenizer", lambda m: m.NumericalFeatureTokenizer(6, 8, True, "uniform"), (6,)),
        Row("ResNet, BatchNorm in eval", tabular, (6,)),
    ],
    "dreamquark-ai/tabnet:pytorch_tabnet.tab_network": [
        Row("FeatTransformer in eval", lambda m: evaluated(m.FeatTransformer(9, 8, None, 2)), (9,))
    ],
    "greydanus/hamiltonian-nn:hnn": [
        Row("HNN.time_derivative", lambda m: m.HNN(4, m.MLP(4, 32, 2)), (4,), method="time_derivative")
    ],
    "tanelp/tiny-diffusion:ddpm": [Row("MLP", lambda m: m.MLP(32, 2, 16), (2, numbers(50)))],
    "tkipf/c-swm:modules": [
        Row("TransitionGNN", lambda m: m.TransitionGNN(4, 16, 2, 3), (of(3, 4), numbers(6)), **INNER),
        Row("EncoderMLP", lambda m: m.EncoderMLP(6, 4, 16, 3), (of(3, 6),), **INNER),
    ],
    "fxia22/pointnet.pytorch:pointnet.model": [
        Row("STN3d in eval", lambda m: evaluated(m.STN3d()), (of(3, 10),), **INNER)
    ],
    "kuangliu/pytorch-cifar:models.senet": [
        Row("BasicBlock in eval", lambda m: evaluated(m.BasicBlock(3, 16)), (of(3, 6, 6),), **INNER)
    ],
    "KindXiaoming/pykan:kan.KANLayer": [Row("KANLayer", lambda m: m.KANLayer(3, 4), (3,))],
    "neuraloperator/neuraloperator/neuralop/layers:channel_mlp": [
        Row("ChannelMLP", lambda m: m.ChannelMLP(3, 4, 16), (of(3, 5),), **INNER)
    ],
    "AdityaLab/pinnsformer:model.qres": [Row("QRes", lambda m: m.QRes(2, 32, 1, 3), (1, 1), second=True)],
    "AdityaLab/pinnsformer:model.fls": [Row("FLS", lambda m: m.FLS(2, 32, 1, 3), (1, 1), second=True)],
    "AdityaLab/pinnsformer:model.pinnsformer": [
        Row("PINNsformer", lambda m: m.PINNsformer(1, 16, 32, 1, 2), (of(5, 1), of(5, 1)), coords=lambda x, t: x[:, 0])
    ],
    "lululxvi/deepxde:deepxde.nn.pytorch.deeponet": [
        Row("DeepONetCartesianProd", deeponet, (6,)),
        Row(
            "DeepONet",
            lambda m: m.DeepONet([6, 32, 16], [2, 32, 16], "tanh", "Glorot normal"),
            (pair(6, 2),),
            coords=lambda x: x[1],
        ),
    ],
}
