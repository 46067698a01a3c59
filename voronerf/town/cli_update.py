"""``voronerf update``: a run brought up to date with new pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from voronerf.app.cli.display import say
from voronerf.app.cli.opening import check_counts
from voronerf.app.run import open_run
from voronerf.app.scenes import load_scene
from voronerf.app.scenes.record import read_scene
from voronerf.app.train.checkpoint import last_checkpoint
from voronerf.app.train.config import ConfigError
from voronerf.app.train.state import stored_values
from voronerf.town.cli_editing import tell
from voronerf.town.editing import check_out


def update(
    run: Path,
    /,
    data: str,
    out: Path | None = None,
    budget: float | None = None,
    old: tuple[str, ...] = (),
    use_old: bool = True,
    more: bool = False,
    downscale: int | None = None,
    allow_outside: bool = False,
    seed: int = 0,
) -> int:
    """Bring a run up to date with new pictures, in new files: cells whose error has grown learn, the others stay.

    Args:
        run: The run directory, which stays as it is.
        data: The new pictures, a scene folder.
        out: The new run directory; default that of the run with -updated behind its name.
        budget: Seconds of training; default a tenth of those of the run, and 10 at least.
        old: Scene folder of the pictures before; default as in training, if that lies in the run directory, the working
            directory or VORONERF_DATA, since a run may be another person's. Of a run that was joined, the folders of
            all runs, in their order.
        use_old: Also learn from the pictures before, where they agree with the new ones.
        more: These are more pictures of the same scene: all cells learn, from old and new pictures alike.
        downscale: Factor on the new images; default as in training.
        allow_outside: Also read images that lie outside of the scene folders.
        seed: Of the rays that are drawn.
    """
    check_counts(downscale=downscale)
    out = run.with_name(f"{run.name}-updated") if out is None else out
    check_out(out)
    if budget is not None and not 0 < budget < float("inf"):
        raise ConfigError(f"--budget must be positive, got {budget}")
    if old and not use_old:
        raise ConfigError("give --old, or --no-use-old, not both")
    record = run / "scene.json"
    if not use_old and not record.is_file():
        raise ConfigError(f"{run}: must hold the record of its scene, scene.json, for --no-use-old")
    config, _ = stored_values(last_checkpoint(run, keep=lambda name: False))
    config = replace(config, data=data, downscale=downscale or config.downscale)
    scene = load_scene(data, allow_outside=allow_outside, **config.reading)
    opened = open_run(run, data=old, scene=None if use_old else read_scene(record), allow_outside=allow_outside)
    return tell(opened.update(scene, out, seconds=budget, data=data, old=use_old, more=more, seed=seed, say=say))
