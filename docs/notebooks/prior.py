# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The energy as a training loss
#
# A very small network learns to find tubes in noise from a few annotated slices: with Dice and cross-entropy, and with
# the curvature prior beside them. It shows how the parts go together; the page
# Benchmarks says what the prior does to real data.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import torch
from torch import nn

import curvafit
from curvafit.priors import CombinedLoss, CurvaturePrior

EDGE, STEPS, SHARE = 32, 30, 0.1
truth = (curvafit.generate("tubes", grid=EDGE, seed=0).field > 0).float()[None, None]
image = truth + 0.8 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))

# %% [markdown]
# Every fourth slice is annotated. The base loss may be any function of an output and a target.

# %%


def base(logits, target):
    """Return cross-entropy plus soft Dice on the annotated slices."""
    x, y = logits[:, :, ::4], target[:, :, ::4]
    p = x.sigmoid()
    dice = 1 - 2 * (p * y).sum() / (p.sum() + y.sum())
    return nn.functional.binary_cross_entropy_with_logits(x, y) + dice


def network():
    torch.manual_seed(0)
    layers = (nn.Conv3d(1, 8, 3, padding=1), nn.ReLU(), nn.Conv3d(8, 8, 3, padding=1), nn.ReLU(), nn.Conv3d(8, 1, 1))
    return nn.Sequential(*layers)


def trained(net, loss):
    adam = torch.optim.Adam(net.parameters(), 1e-2)
    for _ in range(STEPS):
        adam.zero_grad()
        loss(net(image), truth).backward()
        adam.step()
    return net


# %% [markdown]
# The prior takes logits (`sigmoid=True`), reads its coefficients from a preset, from `Coefficients` or from the
# `fit.json` of an example, and acts on all slices. Its weight means nothing by itself: ask for a tenth of the base
# loss's gradient, on a network that has begun to segment.

# %%
alone = trained(network(), base)
prior = CurvaturePrior("tubes", sigmoid=True)
weight = prior.suggest_weight(base, (alone(image).detach().requires_grad_(), truth), share=SHARE)
print(f"weight {weight:.2g}")

both = trained(network(), CombinedLoss(base, prior, weight, warmup=STEPS))

# %%


def scores(net):
    """Return the Dice score on all slices, and what the prior says of the prediction."""
    with torch.no_grad():
        logits = net(image)
        mask = logits > 0
        return float(2 * (mask & (truth > 0)).sum() / (mask.sum() + truth.sum())), float(prior(logits))


results = {"Dice + CE": scores(alone), "with the prior": scores(both)}
for name, (dice, density) in results.items():
    print(f"{name}: Dice {dice:.3f}, energy density {density:.3g}")

# %%
figure, axes = plt.subplots(1, 4, figsize=(9, 2.6), layout="constrained")
panels = {"image": image, "truth": truth, "Dice + CE": alone(image) > 0, "with the prior": both(image) > 0}
for each, (title, volume) in zip(axes, panels.items(), strict=True):
    each.imshow(volume[0, 0, EDGE // 2].numpy(), cmap="gray")
    each.set(title=title, xticks=[], yticks=[])
