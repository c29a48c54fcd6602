"""What tests keep of the runs of members: every bit of them, in a few characters."""

import hashlib
import sys

from cosim.core.recorders import Nothing, end_of_run


class Digest(Nothing):
    """Keeps the hash of all rows: what is equal in it is equal bit for bit."""

    def __init__(self):
        super().__init__()
        self._hash = hashlib.sha256()
        self._times = hashlib.sha256()
        self._events = hashlib.sha256()
        self._begun = False
        self.steps = 0
        self.reason = ""

    def begin(self, plan):
        self._hash.update(repr(plan.layout).encode())
        for name in sorted(plan.designs):
            for key, array in sorted(plan.designs[name].items()):
                self._hash.update(f"{name}.{key}".encode() + array.tobytes())

    def write(self, block, signals):
        first = 1 if self._begun else 0
        self._begun = True
        self.steps = block.index + block.steps
        self._times.update(block.time_ns[first:].tobytes())
        self._hash.update(signals[first:].tobytes())

    def __exit__(self, error_type, error, trace):
        self.reason = end_of_run(error).reason

    def event(self, event):
        self._events.update(repr(event).encode())

    def values(self):
        digests = [part.hexdigest()[:16] for part in (self._hash, self._times, self._events)]
        return {"digest": " ".join(digests)}


def main():
    """Print the digest of a run of its own: of a scenario, and of TOML assignments."""
    import cosim
    from cosim.scenario.document.edits import parse_value

    scenario, *assignments = sys.argv[1:]
    changes = {}
    for assignment in assignments:
        key, _, text = assignment.partition("=")
        changes[key] = parse_value(text)
    digest = cosim.run(scenario, set=changes, recorder=Digest())
    print(digest.values()["digest"])


if __name__ == "__main__":
    main()
