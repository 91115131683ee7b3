"""Options that several commands have, each with its words: what is called alike means the same everywhere."""

from pathlib import Path
from typing import Annotated

import typer

from hil.screen.choices import InProcessLane

# -- what is run -----------------------------------------------------------------------------------------------------

ScenarioName = Annotated[str, typer.Argument(help="A shipped scenario's name or a TOML file.")]
FileInstead = Annotated[str | None, typer.Option(help="Name or file, instead of the scenario's.")]
"""A stage, plant, controller or bus."""
SeedInstead = Annotated[int | None, typer.Option(help="Instead of the scenario's.")]
Faults = Annotated[
    list[str] | None,
    typer.Option(metavar="TARGET:KIND@S[+S][,NAME=VALUE]", help="Such as sense.2:stuck@0.3+0.05; may be repeated."),
]
ChosenLane = Annotated[
    InProcessLane, typer.Option("--lane", help="lockstep: over the simulated bus; fast: compiled, no frames.")
]
NameOrFile = Annotated[str, typer.Option(help="Name or file.")]
"""A stage, controller or bus, where there is no scenario."""
StageFile = Annotated[str, typer.Option(help="Name or file of the stage.")]
ControllerFile = Annotated[str, typer.Option(help="Name or file of the controller.")]
BusFile = Annotated[str, typer.Option(help="Name or file of the bus.")]
Report = Annotated[
    Path | None,
    typer.Option(
        help="conformance.json of `pkxyz check-amplifier` on this very module: what passed is not tried anew."
    ),
]

# -- what a run has learnt, and what is written ----------------------------------------------------------------------

Learn = Annotated[bool, typer.Option("--learn", help="Learn what errs alike in every period of the scan.")]
Apply = Annotated[
    str | None, typer.Option(metavar="FILE", help="Correct by what a run has learnt (its learnt.json), as it is.")
]
Refresh = Annotated[
    str | None, typer.Option(metavar="FILE", help="Begin with what a run has learnt, and go on learning.")
]
Adapted = Annotated[
    str | None, typer.Option(metavar="FILE", help="Begin with what a run has learnt of the device (its adapted.json).")
]
ReplaceEarlier = Annotated[
    bool, typer.Option("--replace", help="An earlier run in --out goes once the new one records; else it is refused.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else.")]
SummaryAsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, and nothing else.")]
AnswerAsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
"""Of commands that print nothing else in any case."""

# -- studies ---------------------------------------------------------------------------------------------------------

AtStrokes = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--at", metavar="Q1 Q2 Q3", help="Strokes in um; default: mid-workspace."),
]
ExcitationSeed = Annotated[int, typer.Option(min=0, help="Of the noise and of the tones' phases.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; default: as many as cores.")]
ClusterAddress = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a Dask cluster to work on instead: tls://HOST:PORT.")
]
ClusterTls = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder with ca.pem, cert.pem and key.pem for a scheduler at tls://.")
]

# -- a stage in operation --------------------------------------------------------------------------------------------

StageCalled = Annotated[str, typer.Option(help="What the stage is called, where there are several.")]
ServedAt = Annotated[str | None, typer.Option(help="The address that serve printed, for a stage elsewhere.")]
ListenAt = Annotated[str, typer.Option(help="Address to listen at. Others than this machine's can reach it then.")]
ListenPort = Annotated[int, typer.Option(help="0: any that is free.", min=0, max=65535)]
OnSilence = Annotated[
    str, typer.Option(help="What becomes of a moving stage when the server falls silent: hold or park.")
]
SilentFor = Annotated[
    float, typer.Option(help="After how long a silent server is taken to be gone.", min=0.03, max=10.0)
]
NativeLoop = Annotated[
    bool | None,
    typer.Option(
        "--native/--no-native", help="The loop in C, or Python's; if not given, the one in C if it was compiled before."
    ),
]
