"""The process of one variant: run it once to look at it, and once more to time it.

The first pass compiles or loads what the second finds ready, so compilation and cold caches never
stand in the second's times; how long the first pass's first step took, and how many modules were
compiled for it, is told apart. Both passes must come to the same bits.
"""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from terrasim.errors import InputError, RunError

BEGUN = time.perf_counter()


def main(job: Path, out: Path) -> None:
    """Do a job and write what came of it: ``out`` holds JSON, and frames lie beside it."""
    told: dict[str, Any] = json.loads(job.read_text(encoding="utf-8"))
    progress: dict[str, Any] = {"step": None}
    try:
        found = _follow(told, out) if told.get("engine") else _run(told, out, progress)
        result = {"status": "done", "found": found}
    except InputError as error:
        # What is refused is refused at the first step at the latest.
        status = "stopped" if progress["step"] else "refused"
        result = {"status": status, "reason": " ".join(str(error).split())}
    except RunError as error:
        result = {"status": "stopped", "reason": " ".join(str(error).split())}
    growing = out.with_name(f"{out.name}.{os.getpid()}")
    growing.write_text(json.dumps({**result, "version": told["version"]}), encoding="utf-8")
    growing.replace(out)


def frames_file(out: Path) -> Path:
    """Where the frames of a result lie."""
    return out.with_suffix(".npz")


def _setup(told: dict[str, Any], folder: Path) -> Any:
    """What a variant's simulations are made from; its store is made in ``folder``."""
    from terrasim.scenario.ground import STORE
    from terrasim.scenario.images import read_images
    from terrasim.scenario.libraries import import_libraries
    from terrasim.scenario.plan import make_plan
    from terrasim.scenario.scenario import parse_scenario
    from terrasim.scenario.schedule import image_files
    from terrasim.scenario.simulation import Setup
    from terrasim.warp_start import start_warp

    start_warp()
    scenario = parse_scenario(told["scenario"], told["name"])
    place = Path(told["folder"])
    source = scenario.terrain.source(place)
    plan = make_plan(scenario, source)
    import_libraries(plan)
    images = read_images(image_files(scenario), place)
    return Setup(scenario, source, plan.anchor, images=images, store=folder / STORE)


def _follow(told: dict[str, Any], out: Path) -> dict[str, Any]:
    """Let another engine do it."""
    import numpy as np

    from terrasim.study.engines import engine
    from terrasim.study.watch import frame_steps

    with tempfile.TemporaryDirectory() as folder:
        setup = _setup(told, Path(folder))
        times_s = setup.dt_s * frame_steps(setup.steps, told["frames"]).astype(np.float64)
        engine(told["engine"]).follow(setup, times_s).save(frames_file(out))
    return {}


def _run(told: dict[str, Any], out: Path, progress: dict[str, Any]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        setup = _setup(told, Path(folder))
        before = _compiled()
        set_up_s = time.perf_counter() - BEGUN
        found = _looked_at(told, out, setup, progress)
        modules = len(_compiled() - before)
    with tempfile.TemporaryDirectory() as folder:
        timed = _timed(_setup(told, Path(folder)))
    if told["scenario"].get("run", {}).get("late") != "fallback" and (
        timed["hashes"] != found["hashes"]
    ):
        raise RunError(
            "two passes over the same variant came to different ends: it does not repeat, so no "
            "error can be told from chance"
        )
    return {**found, **timed, "start_up_s": set_up_s, "modules_compiled": modules}


def _looked_at(
    told: dict[str, Any], out: Path, setup: Any, progress: dict[str, Any]
) -> dict[str, Any]:
    """The first pass."""
    import numpy as np

    from terrasim.scenario.samples import take_samples
    from terrasim.scenario.simulation import Simulation
    from terrasim.scenario.stages import StageTimer
    from terrasim.study.watch import Watch

    begun = time.perf_counter()
    with Simulation(setup, StageTimer()) as simulation:
        watch = Watch(setup, simulation, told)
        first_s = 0.0
        while simulation.step < setup.steps:
            progress["step"] = simulation.step
            simulation.advance()
            simulation.change_ground()
            first_s = first_s or time.perf_counter() - begun
            watch.look()
        heights = [one.height for one in take_samples(setup, simulation)]
        frames = watch.frames(np.concatenate(heights) if heights else np.zeros(0))
        frames.save(frames_file(out))
        return {
            **watch.found(),
            "hashes": _hashes(simulation),
            "first_step_s": first_s or time.perf_counter() - begun,
        }


def _timed(setup: Any) -> dict[str, Any]:
    """The second pass."""
    import warp as wp

    from terrasim.scenario.device_memory import counted_memory
    from terrasim.scenario.samples import take_samples
    from terrasim.scenario.simulation import Simulation
    from terrasim.scenario.stages import StageTimer

    timer = StageTimer()
    with counted_memory() as memory, Simulation(setup, timer) as simulation:
        wp.synchronize_device(simulation.terrain.device)
        stepped = timer.wall_s("step balls")
        begun, cpu = time.perf_counter(), time.process_time()
        while simulation.step < setup.steps:
            simulation.advance()
            simulation.change_ground()
        take_samples(setup, simulation)
        wp.synchronize_device(simulation.terrain.device)
        run_s, cpu_s = time.perf_counter() - begun, time.process_time() - cpu
        counted = {} if simulation.balls is None else simulation.balls.summary()
        on_cuda = simulation.terrain.device.is_cuda
        return {
            **{name: value for name, value in counted.items() if isinstance(value, int)},
            "hashes": _hashes(simulation),
            "steps": setup.steps,
            "simulated_s": simulation.time_s,
            "run_time": run_s,
            "cpu_time": cpu_s,
            # On CUDA a launch returns before its work is done: there the whole loop counts.
            "step_time": run_s if on_cuda else timer.wall_s("step balls") - stepped,
            "stalls": simulation.terrain.cache.counters.stalls,
            "device_memory": memory.peak,
            "memory": _most_memory(),
        }


def _hashes(simulation: Any) -> dict[str, str]:
    """Of the ground and of the balls, as a run's record has them."""
    from terrasim.scenario.fingerprint import hash_arrays, hash_heights

    hashes = {"heights": hash_heights(simulation.terrain)}
    if simulation.balls is not None:
        hashes["balls"] = hash_arrays(*simulation.balls.state())
    return hashes


def _compiled() -> set[str]:
    """Modules that lie compiled in Warp's folder."""
    import warp as wp

    folder = Path(wp.config.kernel_cache_dir or "")
    return {one.name for one in folder.iterdir()} if folder.is_dir() else set()


def _most_memory() -> int | None:
    """Most memory that this process held [bytes]; None where the system does not tell."""
    # The figure of getrusage takes in the parent's, from before this program was begun.
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return None
    line = re.search(r"^VmHWM:\s*(\d+) kB$", status, re.MULTILINE)
    return int(line[1]) * 1024 if line else None


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
