"""Own law: a controller file with other weights, its margins beside those of the shipped one, and what each reaches."""

from pathlib import Path

import hil

text = (hil.CONFIG_DIR / "controllers" / "lqg.toml").read_text(encoding="utf-8")
calmer = text.replace('name = "lqg"', 'name = "calm"').replace("\nforce_n = 2.0e-6", "\nforce_n = 6.0e-6")
assert "\nforce_n = 6.0e-6" in calmer, "the weight that the example changes has moved"
Path("calm.toml").write_text(calmer, encoding="utf-8")

for controller in ("lqg", "calm.toml"):
    law = hil.design(controller)
    margins = law.margins()
    run = hil.run(hil.load_scenario("raster_mild", controller=controller))
    print(
        f"{law.controller.name}: Ms {margins.mimo.peak_s:.2f}, disk margin {margins.mimo.disk_margin:.2f}, "
        f"raster on the mild plant {max(run.summary['rms_error_nm'].values()):.1f} nm rms"
    )
