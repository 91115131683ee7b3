"""Own stage: leaves etched 0.1 um thinner than drawn. What it reaches and holds, and the law designed for it on it."""

import shutil
from pathlib import Path

import hil
from pkxyz_ctrl import Stage

drawn = (hil.CONFIG_DIR / "stages" / "reconstructed.toml").read_text(encoding="utf-8")
thinner = drawn.replace('name = "reconstructed"', 'name = "thinner"')
thinner = thinner.replace("leaf_thickness_m = 8.0e-6", "leaf_thickness_m = 7.9e-6")
Path("thinner.toml").write_text(thinner, encoding="utf-8")
shutil.copy(hil.CONFIG_DIR / "scenarios" / "circle.toml", "circle.toml")

for name in ("reconstructed", "thinner.toml"):
    stage = Stage.load(name)
    top_m = stage.forward_kinematics([25e-6, 25e-6, 25e-6])
    run = hil.run(hil.load_scenario("circle.toml", stage=name))
    print(
        f"{stage.config.name}: stiffness in x {stage.stiffness([0.0, 0.0, 0.0])[0, 0]:.2f} N/m, top corner held by "
        f"{max(stage.holding_voltages(top_m)):.1f} V, circle {max(run.summary['rms_error_nm'].values()):.2f} nm rms"
    )
