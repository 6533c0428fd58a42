"""How near to the true surfaces the mesh of a result lies, beside its points: python -m benchmarks static-mesh."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64
from rich.console import Console
from scipy.spatial import KDTree
from trimesh.sample import sample_surface

from vggtjax.cameras import umeyama_sim3, unproject
from vggtjax.clips.clip import load_clip
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.truth import at_clip_pixels, batched_truth, intrinsics_at_clip_pixels
from vggtjax.errors import InputError
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.research.evaluation.metrics.point_clouds import nearest_distances
from vggtjax.results.exports.mesh import static_mesh
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.shown import shown_points
from vggtjax.storage.markdown import markdown_table
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes import SceneConfig, held_out_scenes
from vggtjax.training.scenes.held_out import Kind

_TRUE_POINTS, _SAMPLES, _MEASURED = 150_000, 200_000, 20_000  # of a clip
_CELLS = 100  # of the points' extent along its longest side: one point of each
ROWS = {
    "points, to the truth": "points",
    "the mesh nearest to each of these points": "mesh_at_points",
    "points, one a cell": "even_points",
    "the mesh, evenly": "even_mesh",
    "from the truth to the points": "truth_to_points",
    "from the truth to the mesh": "truth_to_mesh",
}


def mesh_distance(
    *, model: str = "demo", out: Path = Path("static-mesh-benchmark"), kind: Kind = "dynamic", clips: int = 16,
    frames: int = 12, side: int = 256, consistent_depth: bool = True,
) -> None:  # fmt: skip
    """Measure distances of the static points and of the static mesh of generated clips to the true static surfaces.

    Results are moved onto the truth by the similarity of their static pixels, points and mesh alike. The true surfaces
    are the true points of all frames. Two comparisons give points and mesh the same places: at each point the mesh
    nearest to it; and both evenly in space, as points crowd where the camera is near.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        out: folder for rows.json and report.md.
        kind: of the held-out scenes.
        clips: their number.
        frames: of a clip.
        side: of the rendered pictures, in pixels.
        consistent_depth: fit depth and cameras to the pixels first, as vggtjax reconstruct does.
    """
    if clips < 1:
        raise InputError(f"clips is {clips}; expected at least 1")
    with staging(out):  # an unwritable folder fails now
        pass
    from vggtjax.pipeline.run import reconstruct

    network, console = load_model(model), Console(stderr=True)
    truth = batched_truth(held_out_scenes(kind, clips, SceneConfig(height=side, width=side, frames=frames, samples=2)))
    rows = []
    for number in range(clips):
        true = truth.clip(number)
        clip = load_clip(in_bytes(true.images), size=network.config.image_size, patch=network.config.patch_size)
        result = reconstruct(network, clip, consistent_depth=consistent_depth)
        depth, moving = (at_clip_pixels(clip, maps) for maps in (true.depth, true.dynamic_mask))
        points = _points(depth, intrinsics_at_clip_pixels(clip, true.intrinsics), true.camera_from_world)
        surface = _points(true.depth, true.intrinsics, true.camera_from_world)[~true.dynamic_mask]
        rows.append({"clip": number} | _measured(result, points, result.valid_pixels & ~moving, surface))
        shown = {name: value if isinstance(value, int) else round(value, 3) for name, value in rows[-1].items()}
        console.print(str(shown), highlight=False, soft_wrap=True)
    text = _table(rows)
    with writing(out / "rows.json") as temporary:
        temporary.write_text(json.dumps(rows, indent=1) + "\n")
    with writing(out / "report.md") as temporary:
        temporary.write_text(text + "\n")
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def _points(depth: Any, intrinsics: Any, camera_from_world: Any) -> Float32[np.ndarray, "S H W 3"]:
    matrices = np.broadcast_to(np.asarray(intrinsics, np.float32), (len(depth), 3, 3))
    return unproject(depth.astype(np.float32), matrices, camera_from_world.astype(np.float32), pixel_offset=0.5)


def _measured(
    result: Reconstruction, true_points: np.ndarray, pixels: np.ndarray, surface: Float[np.ndarray, "N 3"]
) -> dict[str, Any]:
    """Return the mean distances of a clip, in metres."""
    similarity = umeyama_sim3(result.world_points()[pixels], true_points[pixels])
    random = np.random.default_rng(0)

    def some(points: np.ndarray, most: int = _MEASURED) -> np.ndarray:
        return points[random.permutation(len(points))[:most]]

    surface = some(surface, _TRUE_POINTS)
    began = time.perf_counter()
    mesh = static_mesh(result)
    seconds = time.perf_counter() - began
    on_mesh = similarity.apply(np.asarray(sample_surface(mesh, _SAMPLES, seed=0)[0]))
    points = similarity.apply(shown_points(result)[0].positions)
    measured, even = some(points), some(_one_a_cell(points))
    ways = {
        "points": (measured, surface),
        "mesh_at_points": (_nearest(measured, on_mesh), surface),
        "even_points": (even, surface),
        "even_mesh": (some(on_mesh), surface),
        "truth_to_points": (some(surface), points),
        "truth_to_mesh": (some(surface), on_mesh),
    }
    distances = {name: float(nearest_distances(*pair).mean()) for name, pair in ways.items()}
    return distances | {"faces": len(mesh.faces), "seconds": seconds}


def _nearest(points: Float64[np.ndarray, "N 3"], others: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "N 3"]:
    return others[KDTree(others).query(points)[1]]


def _one_a_cell(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "M 3"]:
    cells = np.floor((points - points.min(axis=0)) / (np.ptp(points, axis=0).max() / _CELLS)).astype(int)
    return points[np.unique(cells, axis=0, return_index=True)[1]]


def _table(rows: list[dict[str, Any]]) -> str:
    """Return a table: medians of the clips' mean distances."""
    lines = [[words, f"{np.median([row[name] for row in rows]):.3f}"] for words, name in ROWS.items()]
    for words, ours, theirs in (
        ("mesh nearer, at the points", "mesh_at_points", "points"),
        ("mesh nearer, evenly", "even_mesh", "even_points"),
    ):
        lines.append([f"clips with the {words}", f"{sum(row[ours] < row[theirs] for row in rows)} of {len(rows)}"])
    lines.append(["seconds for the mesh", f"{np.median([row['seconds'] for row in rows]):.1f}"])
    return markdown_table(["mean distance (m), median of clips", ""], lines, right=True)
