"""What the clients share: a list of checks that becomes one JSON object and an exit code."""

import json


class BadInput(Exception):
    """A file or an argument is not what it should be, or there is no board."""


class Report:
    """Checks, each with what was found."""

    # Differences of one check that are kept whole; the rest is counted.
    SHOWN = 10

    def __init__(self):
        self.checks = []
        self.findings = {}

    def check(self, name, good, detail=""):
        """Notes a check; whether it was good."""
        self.checks.append({"name": name, "ok": bool(good), "detail": str(detail)})
        return bool(good)

    def check_all(self, name, count, differences):
        """Notes one check of `count` things, of which `differences` tells the bad ones; none at all is bad as well."""
        detail = f"{count} checked"
        if differences:
            more = len(differences) - self.SHOWN
            shown = "; ".join(differences[: self.SHOWN])
            detail += f", {len(differences)} wrong: {shown}" + (f"; and {more} more" if more > 0 else "")
        return self.check(name, count > 0 and not differences, detail)

    def finish(self):
        """Prints the result; the exit code."""
        good = bool(self.checks) and all(check["ok"] for check in self.checks)
        print(json.dumps({"ok": good, "checks": self.checks, **self.findings}, indent=1, ensure_ascii=False))
        return 0 if good else 1
