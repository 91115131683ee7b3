"""Tune: a few trials of a shipped search, margins as constraints; the best numbers as a controller file that runs."""

import hil

if __name__ == "__main__":
    tuned = hil.tune("lqg", trials=3, workers=1, out="tuned")
    if tuned.best is None:
        print("no numbers keep every constraint yet: more trials")
    else:
        print(f"{tuned.controller}: objective {tuned.best.value:.3f}")
        run = hil.run(hil.load_scenario("raster", controller=str(tuned.controller)))
        print(f"raster: {max(run.summary['rms_error_nm'].values()):.2f} nm rms in the worst axis")
