"""Read a recording: columns with units in their names as numpy arrays, pandas and polars; the error's spectrum."""

import numpy as np

import hil

hil.run("circle", out="circle")
run = hil.open_run("circle")
print(f"{len(run.rows)} rows of {len(list(run))} columns, such as position_x_m, voltage_1_v, innovation_z_m")

tracking = run["reference_tick"] >= 0
error_m = (run["position_m"] - run["reference_m"])[tracking]
period_s = run.summary["period_us"] * 1e-6
power_m2_per_hz = np.abs(np.fft.rfft(error_m[:, 0])) ** 2 * 2.0 * period_s / len(error_m)
strongest_hz = np.fft.rfftfreq(len(error_m), period_s)[1 + power_m2_per_hz[1:].argmax()]
print(f"x errs most at {strongest_hz:.0f} Hz")

print(run.to_pandas()[["t_us", "position_x_m", "voltage_1_v"]].describe().loc[["min", "max"]])
print(run.to_polars().select("mode").unique().height, "modes were passed")
