"""First scan: close the loop on a shipped scenario, look at the error, leave a folder with a picture."""

import hil

run = hil.run("raster", out="first_scan")
error_nm = run.summary["rms_error_nm"]
print(f"true position less reference, rms: {error_nm['x']:.2f} / {error_nm['y']:.2f} / {error_nm['z']:.2f} nm")
print(f"largest comb voltage: {run['voltage_v'].max():.1f} V")
print(f"picture and recording: {run.folder}")
