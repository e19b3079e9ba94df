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
# # Shapes, and how far apart they are
#
# Two shapes each of three textures, at 40³ voxels, and the distances between their curvature diagrams. Shapes of one
# texture are nearer to each other than to the others.

# %%
# %matplotlib inline
import curvafit
from curvafit.inference import load_atlas, nearest

flows = {}
for name in ("tubes", "sponge", "bilayers"):
    for seed in (0, 1):
        flows[name, seed] = curvafit.generate(name, grid=40, seed=seed)
        print(name, seed, flows[name, seed].status)

# %%
flows["tubes", 0].plot()

# %%
flows["bilayers", 0].plot()

# %% [markdown]
# A shape's curvature diagram is the distribution of its surface over the two principal curvatures, κ₁ ≥ κ₂. Tubes have
# κ₁ = 1 / radius and κ₂ = 0; layers sit at 0; a sponge bends both ways.

# %%
diagrams = {key: curvafit.diagram(flow.field, flow.grid, 0.02) for key, flow in flows.items()}
diagrams["tubes", 0].plot()

# %% [markdown]
# The distance of two diagrams is the Wasserstein distance, in 1 / working unit (a working unit is 100 voxels).

# %%
distances = {(a, b): curvafit.wasserstein(diagrams[a], diagrams[b]) for a in diagrams for b in diagrams if a < b}
for (a, b), distance in sorted(distances.items(), key=lambda item: item[1]):
    print(f"{distance:5.1f}   {a[0]} {a[1]} - {b[0]} {b[1]}")

# %% [markdown]
# `curvafit infer` searches an atlas, a collection of shapes with their diagrams and parameters. The one that comes with
# the package has 885; these are nearest to the tubes:

# %%
atlas = load_atlas(None)
for match in nearest(diagrams["tubes", 0], atlas, count=3):
    print(f"{match.distance:4.1f}   {match.id}   {match.coefficients}")
