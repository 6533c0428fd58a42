# %% [markdown]
# # Ablate the methods
#
# Which step of the method helps on a clip whose truth is known? `infer` runs both passes over a batch of clips as one
# compiled function; `assemble` makes each method of the ladder from the same two passes.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import vggtjax
from vggtjax.options import ABLATION
from vggtjax.pipeline.pretrained.embedded import demo_clip

model, truth = vggtjax.load_model("demo"), demo_clip()
images = jnp.asarray(truth.images[None])  # [B, S, H, W, 3] in [0, 1]
_, passes = vggtjax.infer(model, images)

# %% [markdown]
# `passes.first` and `passes.second` are what the network predicted, `passes.dynamic_mask` is the mask between them.

# %%
ladder = {name: vggtjax.assemble(passes, method=name) for name in ABLATION}

# %% [markdown]
# ## Depth, by region
#
# AbsRel after one median scale for the clip, over all pixels, over static and over dynamic ones.


# %%
def abs_rel(depth, region):
    scale = np.median(truth.depth / depth)
    return float(np.mean((np.abs(scale * depth - truth.depth) / truth.depth)[region]))


regions = {"all": np.ones_like(truth.dynamic_mask), "static": ~truth.dynamic_mask, "dynamic": truth.dynamic_mask}
scores = {
    name: [abs_rel(np.asarray(assembly.depth[0]), region) for region in regions.values()]
    for name, assembly in ladder.items()
}
for name, row in scores.items():
    print(f"{name:18}", *(f"{value:.3f}" for value in row))

# %%
figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
places = np.arange(len(regions))
for i, (name, row) in enumerate(scores.items()):
    axes.bar(places + 0.2 * i, row, 0.18, label=name)
axes.set_xticks(places + 0.3, list(regions))
axes.set_ylabel("AbsRel, lower is better")
axes.legend(frameon=False, ncols=4)

# %% [markdown]
# Each step repairs something of the one before it: pass 2 alone is worst where things move, taking pass 1 there
# repairs that, and fusing both is better than pass 2 on the rest. With this small model pass 1 alone stays best; what
# VGGT-1B does is another question, and these lines answer it once `model` is `facebook/VGGT-1B`.
#
# ## Is it the mask?
#
# Give the second pass the true mask instead of the mined one.

# %%
given, _ = vggtjax.infer(model, images, masks=truth.dynamic_mask[None])
print("4dvggt-d with the mined mask:", round(scores["4dvggt-d"][0], 3))
print("4dvggt-d with the true mask: ", round(abs_rel(np.asarray(given.depth[0]), regions["all"]), 3))

# %% [markdown]
# ## How many pairs?
#
# The programs that `reconstruct` compiles serve all numbers of pairs in which keys are suppressed.

# %%
for pairs in (0, 1, 3, 5, 8):
    result = vggtjax.reconstruct(model, truth.images, mask_pairs=pairs)
    print(pairs, "pairs:", round(abs_rel(result.depth, regions["all"]), 3))
