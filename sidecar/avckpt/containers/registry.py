# SPDX-License-Identifier: Apache-2.0
"""The protected containers that a sidecar knows, and finding one by name. No I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from avckpt.containers.protected import Protected
from avckpt.errors import Ambiguous, NoSuchContainer

ENDED_KEPT = 32
"""How many containers that have ended `avckpt ps -a` still shows."""


class Registry:
    """Live containers by id, and the last few that have ended."""

    def __init__(self) -> None:
        self._live: dict[str, Protected] = {}
        self._cookies: set[int] = set()
        self._ended: deque[Protected] = deque(maxlen=ENDED_KEPT)

    def add(self, container: Protected) -> None:
        """Adds a container; an earlier run with the same id stays until it is `remove`d."""
        self._live[container.id] = container
        self._cookies.add(container.cookie)

    def remove(self, container: Protected) -> None:
        """Moves a container that has ended to the ended ones."""
        if container.cookie not in self._cookies:
            return
        self._cookies.remove(container.cookie)
        # A restarted container has the same id: its new run may be there already.
        if self._live.get(container.id) is container:
            del self._live[container.id]
        self._ended.append(container)

    def by_id(self, container_id: str) -> Protected | None:
        """The live run of a container."""
        return self._live.get(container_id)

    def live(self) -> list[Protected]:
        """Live containers, oldest first."""
        return list(self._live.values())

    def ended(self) -> list[Protected]:
        """The last few that ended, oldest first."""
        return list(self._ended)

    def find(self, name: str) -> Protected:
        """A live container by name, id or unique id prefix.  Raises NoSuchContainer, Ambiguous."""
        try:
            return find(self._live.values(), name)
        except NoSuchContainer:
            for gone in reversed(self._ended):
                if name and (gone.name == name or gone.id.startswith(name)):
                    how = f"{gone.label} has ended: {gone.reason}; avckpt events {gone.label} tells what happened"
                    raise NoSuchContainer(how) from None
            raise


def find(containers: Iterable[Protected], name: str) -> Protected:
    """As `podman` finds one: the exact name wins, then the exact id, then a prefix of one id only."""
    candidates = list(containers)
    for container in candidates:
        if container.name == name:
            return container
    if name:
        matches = [container for container in candidates if container.id.startswith(name)]
        if len(matches) == 1:
            return matches[0]
        if len(matches) > 1:
            ids = ", ".join(container.id[:12] for container in matches)
            raise Ambiguous(f"{name!r} may be any of {ids}: give more digits, or the name")
    near = _near(candidates, name)
    if near:
        raise NoSuchContainer(f"no protected container is called {name!r}: did you mean {near}? See avckpt ps")
    raise NoSuchContainer(
        f"no protected container is called {name!r}: see avckpt ps; was it started with "
        "--label avckpt.enable=true, and are the hooks installed (avckpt doctor)?"
    )


def _near(containers: Iterable[Protected], name: str) -> str:
    """Whose name may have been meant; "" if none looks like it."""
    import difflib

    names = {container.name.lower(): container.name for container in containers if container.name}
    for each in names.values():
        if each.endswith(f"/{name.strip()}"):  # a node, without its container
            return each
    close = difflib.get_close_matches(name.strip().lower(), names, n=1, cutoff=0.75)
    return names[close[0]] if close else ""
