"""Monte Carlo: a law on sampled plants, how many hold, and the worst of them again alone."""

import hil

if __name__ == "__main__":
    sampled = hil.montecarlo("steps", plants=4, workers=1, out="montecarlo")
    found = sampled.summary
    print(f"{found['plants']} plants, {found['not_held']} did not hold; Ms at most {found['peak_s']['max']:.2f}")
    alone = hil.run(sampled.scenario_of(found["worst_seed"]))
    print(f"the worst one, seed {found['worst_seed']}: {max(alone.summary['rms_error_nm'].values()):.1f} nm rms")
