# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Find a missing effect, in Python
#
# The recording is four seconds of a servo that swings a payload. Its nominal model lacks one physical effect. This
# notebook finds out which: it compares the model with the measurements, diagnoses what is missing, adds it and compares
# again. It runs in a quarter of a minute on one core.
#
# The file is a Python script in jupytext's percent format. Jupyter opens it with the jupytext extension;
# `jupytext --to ipynb hidden_effect.py` makes an `.ipynb` of it.

# %%
import matplotlib.pyplot as plt

import concent_warp as cw

# %% [markdown]
# ## Load
# A recording holds the commands, the measurements and the scene in which they were made.

# %%
recording = cw.load_recording(cw.example("servo"))
(demonstration,) = recording.demonstrations
for name, channel in {**demonstration.action, **demonstration.measured}.items():
    print(f"{name}: {len(channel.time)} samples in {channel.time[-1]:.1f} s")

# %% [markdown]
# ## Compare
# The nominal model is the scene of the recording as it stands. `compare` replays the commands in it and divides the
# error by the one that the measurement noise alone would leave: 1 x noise is as good as a model can be.

# %%
nominal = cw.Model.from_recording(recording)
comparison = cw.compare({"nominal": nominal}, recording)
for channel in comparison.channels:
    summary = comparison.summarise("nominal", channel)
    print(f"{channel}: RMS error {summary.rms:.2g} {summary.unit} = {summary.ratio:.1f} x noise")

# %% [markdown]
# The error of the encoder is seven times its noise: the model is wrong, but the figures do not say how.
#
# ## Diagnose
# `diagnose` fits every effect of the library that could act here, judges each on data that its fit has not seen, and
# accepts one if it explains more than the best of all candidates would where nothing is missing.

# %%
diagnosis = cw.diagnose(nominal, recording)
print(diagnosis.headline)
print(*diagnosis.sentences(), sep="\n")
diagnosis

# %%
first = [finding for finding in diagnosis.effects if finding.step == 0][:6]
figure, axes = plt.subplots(figsize=(7, 2.6), layout="constrained")
bars = axes.barh([finding.name for finding in first], [100 * finding.gain for finding in first])
axes.bar_label(bars, fmt="%.0f %%", padding=3)
axes.invert_yaxis()
axes.set(xlim=(0, 105), xlabel="held-out error that the effect takes away [%]")
plt.show()

# %% [markdown]
# Several effects take away half of the error, for all of them make the joint come late. One takes away nearly all.
#
# ## Add
# `diagnosis.model` has the effect already. By hand it is one call to add it, at the value at which it does nothing, and
# one to fit it:

# %%
fitted = cw.fit_effects(nominal.add_effect("joint_friction"), recording)
for parameter in fitted.parameters[0]:
    print(f"{parameter.name} = {parameter.value:.4f} [{parameter.low:.4f}, {parameter.high:.4f}] {parameter.unit}")

# %% [markdown]
# The recording was made with 0.03 N m.
#
# ## Compare again

# %%
comparison = cw.compare({"nominal": nominal, "with friction": fitted.model}, recording)
for channel in comparison.channels:
    before, after = (comparison.summarise(model, channel).ratio for model in comparison.models)
    print(f"{channel}: {before:.1f} -> {after:.1f} x noise, {comparison.difference(channel).verdict}")
comparison  # Jupyter shows it as a table

# %%
figure, axes = plt.subplots(figsize=(7, 2.6), layout="constrained")
for model in comparison.models:
    residual = comparison.residual(model, demonstration.name, "hinge_position")
    axes.plot(residual.time, residual.ratio, linewidth=0.8, label=model)
axes.set(xlabel="time [s]", ylabel="error of the encoder / noise")
axes.legend()
plt.show()

# %% [markdown]
# What is left is noise. The tutorial "A recording that hides an effect" does the same on the command line, and shows
# what happens if one guesses.
