# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 3. Why the smoother wins, and what it needs for that
#
# A smoother beats a filter. But the two differ in many things at once: what they remember, what they linearise and
# when, whether they may look ahead. Which of these makes the difference? And why does it win less often on a real
# drive than in a simulation?
#
# So we climb a **ladder** of estimators, from dead reckoning to the batch smoother. Each rung says what it changes
# against the one before. Then we take it to a real drive, and look at what its measurements are like.

# %%
from itertools import pairwise
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from recordings import real

from toolkit import Result, compare, explain
from toolkit.noise import Card
from toolkit.registry import ladder
from toolkit.report.card import card_lines
from toolkit.report.headers import noise_line
from toolkit.report.messages import consistency_lines

# %matplotlib inline
plt.rcParams |= {"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True, "grid.alpha": 0.3}

# %%
rungs = ladder()
width = max(len(rung.name) for rung in rungs)
for rung in rungs:
    print(f"{rung.name:{width}}  {rung.change()}")

# %% [markdown]
# What each of them does is in the [page on estimators](../docs/estimators.md).
#
# ## In simulation, over seeds
#
# `flight` is a hand-held camera with an IMU. Every seed draws a new start, new biases and new noise. The truth is
# exact, so we can ask two questions: how large is the error, and **does the estimator state how large it is**?
#
# The second is answered by the NEES: the squared error over the covariance that the estimator itself states. For a
# consistent estimator it is 1 on average; chance lets the mean over several seeds scatter within a known band.

# %%
SEEDS, FRAMES = 3, 20
# A window of half a second, so that poses leave it within these frames.
over = compare("flight", "ladder", seeds=SEEDS, max_frames=FRAMES, settings={"window": {"lag_s": 0.5}})
over.table("ATE none", "NEES rot", "NEES pos", "NEES pose")

# %%
over.figures["nees_over_seeds"]

# %%
print(*consistency_lines(over.comparison), sep="\n")

# %% [markdown]
# Three steps of the ladder can be seen here.
#
# **Count every measurement once.** The lowest filters use the same sightings to correct the map by the pose and the
# pose by the map, and neglect that the errors of both are now correlated. Their covariance shrinks far faster than
# their error: the NEES leaves its band by orders of magnitude. A filter that is so overconfident gives new measurements
# hardly any weight. Dead reckoning, with its large error, is consistent: it states a large covariance.
#
# **Remember what depends on what.** With all cross-covariances in one Gaussian the NEES comes down to its band. The
# covariance that the filter states is now right.
#
# **Do not linearise too early.** A filter linearises each sighting once, at its estimate of that moment. If that was
# wrong, the linearisation stays wrong for good. A smoother keeps the sighting itself and linearises again at a better
# estimate.

# %%
rows = {row.estimator: row for row in over.comparison.rows}  # the final one stays
_, axes = plt.subplots(figsize=(8, 4))
for name, row in rows.items():
    spread = row.spread("ate_none_m")
    if spread is not None:
        quartiles = 1000 * spread.lower_quartile, 1000 * spread.upper_quartile
        axes.plot(quartiles, (name, name), color="#0072B2", alpha=0.3, linewidth=7, solid_capstyle="butt")
        axes.plot(1000 * spread.mean, name, "o", color="#0072B2")
axes.set(xscale="log", xlabel=f"position error, ATE from the first pose on [mm]: mean and quartiles of {SEEDS} seeds")
axes.set_xticks([2, 5, 10, 20, 50, 100], ["2", "5", "10", "20", "50", "100"])
axes.minorticks_off()
axes.invert_yaxis()
plt.show()

# %%
error_m = {name: spread.mean for name, row in rows.items() if (spread := row.spread("ate_none_m"))}
for before, rung in pairwise(rungs):
    if before.name in error_m and rung.name in error_m:
        ratio = error_m[rung.name] / error_m[before.name]
        print(f"{rung.name:{width}}  {100 * (ratio - 1):+5.0f} %  {rung.change()}")

# %% [markdown]
# Each line is the change of the mean error against the rung before. Not every step down the list is a gain on every
# recording: a window of past poses, for one, gives up accuracy of the map for a cost that does not grow.
#
# ## One ingredient at a time
#
# A rung may change several things at once, and with three seeds a change of some percent may be luck. `explain` asks
# the question properly. Every estimator declares which **ingredients** it has; two variants that differ in a single one
# are run on the same seeds, and the ratio of their errors is what that ingredient brings. It is **added** as near to
# the first estimator as there is such a pair, and **taken** away as near to the second, because what it brings depends
# on what else is there.

# %%
WHY_SEEDS = 8
why = explain("flight", "ekf", "batch", seeds=WHY_SEEDS, max_frames=40, settings={"window": {"lag_s": 0.5}})
print(fill(why.words, 110))

# %%
why.figures["waterfall"]

# %% [markdown]
# Blue bars tell of the first estimator: what it gains where an ingredient is added, what it loses where one is taken
# away that it has. Orange bars tell what the second loses. The lines are 95 % intervals, and pale bars are what this
# many seeds cannot tell from chance. The bars do not add up to the whole, and need not: an ingredient may do nothing
# until another is there.
#
# The table has the same for the variance of the pose and for the NEES. Cross-covariances make the filter more accurate,
# and far more *honest*: the NEES falls by much more than the error does.

# %%
why.table()

# %% [markdown]
# ## The future
#
# The last advantage is no trick of estimation. A smoother that answers at every frame is a filter for that moment; only
# its *final* answer has seen what came after. Those rungs that give both show how much that is worth.

# %%
for (estimator, output), values in over.metrics.items():
    now, later = values["ate_none_m"], over.metrics[estimator, "final"]["ate_none_m"]
    if output == "causal" and now != later:
        print(f"{estimator:{width}}  causal {1000 * now:.1f} mm, final {1000 * later:.1f} mm")

# %% [markdown]
# ## A real drive
#
# So much for a world whose measurements are as the estimators assume: with white noise of a known size. With the course
# file 0027 at hand, here are the first 40 s of it (KITTI raw 2011_09_30_drive_0027: real stereo, and velocities with
# noise added by the course). Without it, the built-in `drive-realistic` stands in, a simulation whose tracks err as
# those of KITTI do.
#
# On a drive we look first at the KITTI benchmark's **drift in percent** of the way, and at the error after fitting
# **heading and position**. An SE(3) fit may also tilt the world, which hides errors of height, and on a single drive it
# distinguishes good estimators by luck.

# %%
CHOSEN = ["dead-reckoning", "ekf", "msckf-fej", "batch"]
COLUMNS = "kitti_t_percent", "kitti_r_deg_per_m", "ate_yaw_m", "reproj held-out", "NEES pose"
recording, truth = real("ucsd/0027.npz"), real("ucsd/gt/0027.tum")
if recording and truth:
    print("this ran on the real drive 0027, its first 400 frames, with ground truth")
    SOURCE = {"source": str(recording), "truth": truth, "max_frames": 400}
else:
    print("0027 is not here: this ran on the simulation drive-realistic, 16 s of it at 5 Hz")
    SOURCE = {"source": "drive-realistic", "to_s": 16.0, "every": 2}

# Each sighting counts in full, as where noise is white and every error is drawn anew.
IN_FULL = {"noise": {"track_weight": 1.0}}
white = compare(**SOURCE, estimators=CHOSEN, settings=IN_FULL)
white.table(*COLUMNS)

# %% [markdown]
# The smoother no longer wins by the factors of the simulation: on a real drive a filter may well be as good. And the
# error it states is too small, its NEES is above 1. More measurements did not help as much as it assumed. So what are
# they like?
#
# ## Tracks are not white
#
# A tracker follows a patch from image to image and adds a little error at every step; and it has matched left and right
# once, so that a track's disparity is off by the same amount for its whole life. The **card** of a recording says so.
# It needs no truth: on stretches of the recording all poses and landmarks are adjusted together, and the card describes
# what is left of the sightings.

# %%
measured = compare(**SOURCE, estimators=CHOSEN, settings={"card": True})
card = measured.comparison.card
print(*card_lines(card), sep="\n")

# %% [markdown]
# How alike are the residuals of two sightings of one track? White errors would leave residuals that do not know of each
# other (a little below zero, because the landmark was fitted to them).


# %%
def show_card(card: Card) -> None:
    """Draw how the residuals along a track are correlated, by channel."""
    _, axes = plt.subplots(figsize=(7, 3.2))
    channels = ("mean column", "#D55E00"), ("disparity", "#0072B2"), ("row", "#009E73")
    for (name, colour), values in zip(channels, card.correlation.T, strict=True):
        axes.plot(np.arange(1, len(values) + 1), values, "o-", color=colour, label=name)
    axes.axhline(0.0, color="#1a1a1a", linewidth=1)
    axes.set(xlabel="frames apart", ylabel="correlation", title="residuals along a track; black: if they were white")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    plt.show()


show_card(card)

# %% [markdown]
# An estimator that assumes white noise counts the twentieth sighting of a track for as much information as the second.
# But most of it is the error of the one before, once more. It averages what does not average out, and its covariance
# shrinks faster than its error. The smoother uses *all* sightings at once, so its covariance suffers most; a filter
# that marginalises the past is spared a part.
#
# ## Weighted by their information
#
# So how much a sighting counts is measured: once, before any estimator runs, and for all of them alike. That is the
# default; above, every sighting counted in full. How it is measured is in the [page on real tracks](../docs/tracks.md).

# %%
print(noise_line(measured.comparison))
measured.table(*COLUMNS)


# %%
def show_change(before: Result, after: Result, metrics: dict[str, str]) -> None:
    """Draw a metric a panel: final answers with vision, sightings in full (open) and weighted (filled)."""
    _, panels = plt.subplots(1, len(metrics), figsize=(10, 2.2), sharey=True)
    for axes, (key, words) in zip(panels, metrics.items(), strict=True):
        for name in CHOSEN[1:]:
            old, new = before.metrics[name, "final"][key], after.metrics[name, "final"][key]
            axes.annotate("", (new, name), (old, name), arrowprops={"arrowstyle": "->", "color": "#8a949f"})
            axes.plot(old, name, "o", color="#0072B2", markerfacecolor="white")
            axes.plot(new, name, "o", color="#0072B2")
        axes.set(xlabel=words)
        axes.set_xlim(left=0.0)
    panels[0].invert_yaxis()
    plt.show()


show_change(
    white, measured, {"kitti_t_percent": "KITTI drift [%]", "ate_yaw_m": "ATE, heading and position fitted [m]"}
)

# %%
for name in CHOSEN:
    old, new = (result.metrics[name, "final"]["kitti_t_percent"] for result in (white, measured))
    if old and new and old != new:
        print(f"{name:{width}}  drift {old:.2f} % -> {new:.2f} %")

# %% [markdown]
# On these 400 frames of 0027 the filter's drift halves and the smoother's hardly changes, while the error they state
# comes much closer to the one they make: the NEES of both falls to a half and less. One drive is one draw of luck; the
# [page on real tracks](../docs/tracks.md) has more of them.
#
# ## What it costs
#
# Processor time per frame on the drive, the finish included, to one digit: it depends on the machine.

# %%
for run in measured.runs.values():
    ms = 1000 * run.timings.cpu_s / measured.comparison.sequence.frame_count
    print(f"{run.estimator:{width}}  {float(f'{ms:.0e}'):g} ms")

# %% [markdown]
# ## What remains
#
# The smoother wins because it counts every measurement once, remembers what depends on what, linearises late, and, at
# the end, uses the future. The first two a filter can have as well: a joint filter is as consistent as the smoother.
# The third it can have in part, by iterating. The fourth it cannot.
#
# And it wins where the noise of its measurements is right: it uses all of them with that noise.
#
# Try other seeds and lengths, and look at your own recording; each is one command:
#
#     vislam explain flight --from ekf --to batch --seeds 12 --until 30s
#     vislam explain my_drive.npz
#     vislam compare flight --estimators ladder --seeds 20 --max-frames 100
#     vislam card my_drive.npz
#     vislam compare my_drive.npz --set noise.track_weight=1
