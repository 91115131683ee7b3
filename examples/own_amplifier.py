"""Own amplifier: the same conformance run that a module on a real bus has to pass, here on the simulated node."""

import json
import subprocess
import sys

words = [sys.executable, "-m", "hil.cli", "check-amplifier", "--json"]
done = subprocess.run(words, capture_output=True, text=True, check=False)
report = json.loads(done.stdout)
for line in report["lines"][:5]:
    print(line["verdict"], line["group"], "-", line["name"])
print("may be enabled" if report["ok"] else "must not be enabled", f"({len(report['lines'])} lines)")
