"""The script that runs in each of two versions of the code while they are timed (:mod:`toolkit.gate.interleaved`).

It is started with one version first on the path, so that it imports that version's estimators. Requests are lines of
JSON on standard input, answers lines of JSON on standard output. It must use only functions that earlier versions have.
"""

import gc
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

Json = dict[str, Any]


class Timer:
    """One version of the code, with the recording that its estimators are timed on."""

    def __init__(self) -> None:
        self._prepared: Any = None
        self._settings: Any = None

    def where(self, requested: Json) -> Json:
        """Return where the toolkit and each estimator come from; an estimator that is not there has no file."""
        from toolkit.errors import VislamError
        from toolkit.registry import find

        files: dict[str, str | None] = {}
        for name in requested["estimators"]:
            try:
                files[name] = sys.modules[find(name).load().__module__].__file__
            except VislamError:
                files[name] = None
        return {"toolkit": sys.modules["toolkit"].__file__, "files": files}

    def prepare(self, requested: Json) -> Json:
        from toolkit.experiment.recording import Recording, prepare
        from toolkit.settings.reading import settings_of

        self._settings = settings_of(requested["settings"], "the baseline's settings")
        truth = None if requested["truth"] is None else Path(requested["truth"])
        recording = Recording(
            requested["source"],
            requested["seed"],
            truth,
            start=self._settings.start,
            duration_s=requested["duration_s"],
            noise=self._settings.noise,
            frontend=self._settings.frontend,
            tracks=self._settings.tracks,
        )
        self._prepared = prepare(recording)
        return {}

    def run(self, requested: Json) -> Json:
        from toolkit import runner
        from toolkit.progress import SILENT
        from toolkit.registry import find

        name, prepared = requested["estimator"], self._prepared
        gc.collect()
        run = runner.run(name, find(name).load(), prepared.sequence, prepared.prior, SILENT, self._settings)
        return {"status": run.status, "cpu_s": None if run.timings is None else run.timings.cpu_s}


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # nothing that is printed shall look like an answer
    timer = Timer()
    for line in sys.stdin:
        requested = json.loads(line)
        try:
            answer = getattr(timer, requested["do"])(requested)
        except Exception as error:
            answer = {"error": " ".join(f"{type(error).__name__}: {error}".split())}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
