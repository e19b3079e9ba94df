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
# # From a volume to its parameters
#
# A shape of known parameters stands in for a scan: so the answer can be checked. It is small (40³ voxels), to run in a
# minute or two; take 100³ for figures to rely on.

# %%
# %matplotlib inline
import curvafit
from curvafit.inference import Growth

truth = curvafit.preset("sponge")
flow = curvafit.generate("sponge", grid=40, seed=0)
print(flow.status)

# %% [markdown]
# A `Volume` is values with voxel edges and a unit. Here the values are a phase field: about +1 inside, -1 outside, with
# a smooth step between. `kind="field"` says so, and `periodic=True` that the box repeats. A scan needs neither.

# %%
scan = curvafit.Volume(flow.field.numpy(), (20.0, 20.0, 20.0), "um")
fewer = Growth(twins=1)  # shapes than by default, so that this page is made soon
inference = curvafit.infer(scan, kind="field", periodic=True, seed=1, growth=fewer)
fit = inference.fit
print(fit.status)

# %% [markdown]
# `status` is to be read first: it names the law that is best supported, if any is. Several candidates were grown, and
# the chosen one is the nearest. A phase field gives its coefficients back by stationarity:

# %%
print("      truth  inferred     ±")
for name, value in truth.coefficients.as_dict().items():
    print(f"{name} {value:8.2f} {fit.coefficients.as_dict()[name]:8.2f} {fit.uncertainty.get(name, float('nan')):8.2f}")
print(f"mass {truth.mass:7.3f} {fit.mass:8.3f}")

# %% [markdown]
# The same parameters with lengths in the scan's unit (a10 and a01 per µm, a00 per µm²):

# %%
print(fit.coefficients_physical)
print(f"ε = {fit.epsilon_physical:g} {fit.length_unit}")

# %% [markdown]
# The scan, and its twin: another shape, grown from other noise with the inferred parameters.

# %%
inference.plot()

# %% [markdown]
# The curvature diagram of the scan: how much of its surface has the principal curvatures κ₁ and κ₂. Inference compares
# these diagrams.

# %%
inference.diagram.plot()
