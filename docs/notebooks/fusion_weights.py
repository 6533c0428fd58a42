# %% [markdown]
# # Fusion weights with optax
#
# The paper weights the two passes by their confidence, as if it were inverse variance. Here the precision of pass i
# is exp(a_i) C_i^b_i, and a, b are fitted to a clip with true depth. One clip is no data set: `vggtjax fit-fusion`
# fits to many and scores on others. This shows how the parts go together.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import vggtjax
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.research.learning import fuse, negative_log_likelihood, observe, paper_rule

model, truth = vggtjax.load_model("demo"), demo_clip()
images, true_depth = jnp.asarray(truth.images[None]), jnp.asarray(truth.depth[None])
_, passes = vggtjax.infer(model, images)
seen = observe(passes)  # what a rule may look at

# %% [markdown]
# ## The loss
#
# How likely is the true depth, if the fused precision is right? `paper_rule()` is the paper's rule, a tree of numbers;
# `scale` and `power` are the a and b of both passes.


# %%
def rule_of(free):
    return paper_rule() | free


def loss(free):
    return negative_log_likelihood(fuse(rule_of(free), seen), true_depth)


free = {name: paper_rule()[name] for name in ("scale", "power")}
print("the paper's rule:", float(loss(free)), "nats a pixel")

# %% [markdown]
# ## Fit
#
# The passes are computed once. A step of the fit does not touch the network, so it takes milliseconds.

# %%
optimiser = optax.adam(0.05)


@jax.jit
def step(free, state):
    value, slopes = jax.value_and_grad(loss)(free)
    updates, state = optimiser.update(slopes, state, free)
    return optax.apply_updates(free, updates), state, value


state, losses = optimiser.init(free), []
for _ in range(200):
    free, state, value = step(free, state)
    losses.append(float(value))
print("fitted:", losses[-1], {name: np.round(np.asarray(value), 2).tolist() for name, value in free.items()})
assert losses[-1] < losses[0]

# %%
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(losses)
axes.set(xlabel="step", ylabel="nats a pixel")

# %% [markdown]
# ## What changed
#
# The power says how precision grows with confidence; 1 is the paper's. The fused depth changes little where both
# passes are alike in their confidence, and the fused precision changes much.

# %%
paper, fitted = fuse(paper_rule(), seen), fuse(rule_of(free), seen)


def abs_rel(depth):
    depth = np.asarray(depth[0])
    scale = np.median(truth.depth / depth)
    return float(np.mean(np.abs(scale * depth - truth.depth) / truth.depth))


print("AbsRel of the paper's rule:", round(abs_rel(paper.depth), 3), "fitted:", round(abs_rel(fitted.depth), 3))

# %% [markdown]
# `vggtjax.research.learning.save_fusion` writes a rule that `vggtjax reconstruct --fusion` reads, and `fit_fusion` does
# all this with early stopping on other clips.
