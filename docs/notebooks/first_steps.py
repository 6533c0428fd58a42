# %% [markdown]
# # First steps
#
# From a clip to depth, cameras, masks and points, with the small model that comes with the package. Everything here
# runs in seconds, without a GPU or a network. For real footage put a video and `facebook/VGGT-1B` in the place of
# clip and model.

# %%
import matplotlib.pyplot as plt
import numpy as np

import vggtjax
from vggtjax.cameras import world_from_camera
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.research.evaluation import mask_scores, trajectory_errors, video_depth_errors

model = vggtjax.load_model("demo")
truth = demo_clip()  # a generated clip whose depth, masks and cameras are known exactly
clip = vggtjax.load_clip(truth.images, model=model)
print(len(clip), "frames of", clip.images.shape[1:3], "pixels")

# %% [markdown]
# ## Reconstruct
#
# The first call compiles for clips of this shape; the second one only runs.

# %%
result = vggtjax.reconstruct(model, clip)
print(result)

# %% [markdown]
# ## Look
#
# Depth is z in the camera, up to one scale. The saliency has a number for each patch of 8 x 8 pixels, the mask a
# decision for each pixel.

# %%
frames = (0, 5, 10, 15)
figure, axes = plt.subplots(4, len(frames), figsize=(8, 8), layout="constrained")
rows = {
    "picture": result.images,
    "1 / depth": 1 / result.depth,
    "saliency": result.saliency,
    "objects": result.instances,
}
for row, (name, values) in zip(axes, rows.items(), strict=True):
    row[0].set_ylabel(name)
    for cell, frame in zip(row, frames, strict=True):
        cell.imshow(values[frame])
        cell.set(xticks=[], yticks=[])

# %% [markdown]
# ## Points and cameras
#
# `world_points()` lifts every pixel into the world, whose axes are approximately the first camera's: x right, y down,
# z forward. Project a point into another frame, and you get a pixel of that frame:

# %%
points = result.world_points()  # [S, H, W, 3]
static = points[~result.dynamic_mask & result.valid_pixels]
print("static points:", static.shape, "cameras:", result.camera_centres.shape)

rotation, translation = result.camera_from_world[9, :, :3], result.camera_from_world[9, :, 3]
in_camera = rotation @ points[0, 32, 32] + translation
pixel = result.intrinsics[9] @ (in_camera / in_camera[2])
print("the middle of frame 0 is at", pixel[:2].round(1), "in frame 9")

# %% [markdown]
# The centre of the first pixel is (0.5, 0.5): lifting and projecting in the same frame gives pixel centres.

# %%
back = result.camera_from_world[0, :, :3] @ points[0, 32, 32] + result.camera_from_world[0, :, 3]
pixel = result.intrinsics[0] @ (back / back[2])
assert np.allclose(pixel[:2], (32.5, 32.5), atol=1e-2)

# %% [markdown]
# ## Compare with the truth
#
# Predictions are up to a scale, so depth is compared after one factor for the clip, and cameras after a similarity.

# %%
print(video_depth_errors(result.depth, truth.depth, align="median"))
print(trajectory_errors(result.world_from_camera, world_from_camera(truth.camera_from_world), align="sim3"))
print(mask_scores(result.dynamic_mask, truth.dynamic_mask))

# %% [markdown]
# ## Save, and load again

# %%
result.save("first-steps")
again = vggtjax.Reconstruction.load("first-steps")
assert np.array_equal(again.depth, result.depth)
