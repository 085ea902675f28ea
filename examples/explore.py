# SPDX-License-Identifier: Apache-2.0
"""A calibration in a notebook: load, look, evaluate points, compare two."""

# %% [markdown]
# # A calibration in a notebook
# Loads two results, draws one, evaluates points with their uncertainty, and compares both. Open
# this page with Jupytext in Jupyter, or in VS Code; `python examples/explore.py` runs it as well.

# %%
from pathlib import Path

import numpy as np

from selfcal_ros.apply import load
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError

# %% [markdown]
# Two simulated measurements of one machine stand in for yours. They write into this folder.

# %%
SIMULATION = """
plan:
  plan_id: small
  artifact: {{grid_size: 5, grid_pitch: 0.01, angular_count: 0}}
  views: [{{name: v0, repeats: 4}}, {{name: v1, repeats: 4, rotation_deg: 90}},
          {{name: v2, repeats: 4, translation_pitch: [1, 0]}}]
  check_stops: {{marks: 5, offset: 20.0e-6}}
seed: 3            # of the machine
noise_seed: {day}
truth: {{correlation: 3}}
noise: {{sigma_xy: 2.0e-8}}
cell: {{visit_order: there_and_back}}
"""
for day in (1, 2):
    if not Path(f"day_{day}.json").exists():
        Path(f"day_{day}.yaml").write_text(SIMULATION.format(day=day))
        main(["simulate", f"day_{day}.yaml", "-o", f"day_{day}"])
        main(["solve", f"day_{day}", "--quiet", "-o", f"day_{day}.json"])

# %% [markdown]
# ## Load and look
# A notebook shows the picture for the object itself; `plot` returns it as a figure of matplotlib.

# %%
stage = load("day_1.json")
print(stage)
stage.plot().savefig("day_1.png")

# %% [markdown]
# ## Points with their uncertainty
# Where to send the stage to be truly at some points, and how well that is known (u, k = 1).

# %%
x, y = np.array([-0.012, 0.0, 0.007]), np.array([0.003, 0.0, -0.018])
x_command, y_command = stage.command(x, y)
u_x, u_y = stage.uncertainty(x, y)
for i in range(len(x)):
    print(
        f"at {x[i]:+.3f} {y[i]:+.3f} m: add {1e6 * (x_command[i] - x[i]):+.3f} "
        f"{1e6 * (y_command[i] - y[i]):+.3f} µm, u {1e6 * u_x[i]:.3f} {1e6 * u_y[i]:.3f} µm"
    )

# %% [markdown]
# ## Compare two
# What no view determines (translation, rotation, scale) is removed, as by `selfcal diff`.

# %%
difference = stage.difference(load("day_2.json"))
print(
    f"rms {1e6 * difference.rms_m:.3f} µm, largest {1e6 * difference.max_m:.3f} µm, "
    f"significant: {difference.significant}"
)

# %% [markdown]
# ## As a table
# Of the libraries that are installed here: pandas, xarray.

# %%
for table in (stage.to_dataframe, stage.to_xarray):
    try:
        print(table())
    except InputError as error:  # it says how to install the library
        print(error)
