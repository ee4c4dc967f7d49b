# SPDX-License-Identifier: Apache-2.0
"""The API's description: valid, and complete for paths and fields."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, cast

from avckpt.api.openapi import document
from avckpt.api.server import ApiServer, Backend
from avckpt.containers.protected import Protected
from avckpt.errors import KernelError
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind
from avckpt.guard import GuardConfig
from openapi_spec_validator import OpenAPIV31SpecValidator


def test_it_is_valid_openapi() -> None:
    assert [str(error) for error in OpenAPIV31SpecValidator(cast("Any", document())).iter_errors()] == []


def test_it_describes_exactly_the_paths_that_are_served() -> None:
    served = set()
    for route in ApiServer(cast("Backend", None), Path("unused")).app.router.routes():
        assert route.resource is not None
        if route.method == "HEAD":
            continue
        path = route.resource.canonical
        if path.endswith("/{command}"):
            served |= {(route.method, path.replace("{command}", verb)) for verb in ("checkpoint", "restore")}
        else:
            served.add((route.method, path))
    described = {(method.upper(), path) for path, item in document()["paths"].items() for method in item}
    assert described == served


def test_it_describes_exactly_the_fields_that_are_given() -> None:
    schemas = document()["components"]["schemas"]
    assert list(schemas["Event"]["properties"]) == [each.name for each in fields(EventRecord)] + ["message"]
    for required in schemas["Event"]["required"]:
        assert required in EventRecord(Kind.ENDED).to_json()
    config = GuardConfig(3.0, 2, True, True, frozenset(), 5, 60.0, 0.02)
    container = Protected(id="ab" * 32, name="web", cookie=1, init_pid=1, config=config, registered_at=0.0)
    assert list(schemas["Container"]["properties"]) == list(container.to_json())
    assert list(schemas["Error"]["properties"]) == list(KernelError("x").to_json())


def test_every_field_of_an_event_is_in_the_manual() -> None:
    manual = (Path(__file__).parents[2] / "docs" / "events.md").read_text()
    for each in fields(EventRecord):
        meaning = each.metadata["description"].replace("|", "\\|")
        assert f"| `{each.name}` | {meaning} |" in manual, each.name
    for kind in Kind:
        assert f"`{kind.value}`" in manual


def test_every_path_is_in_the_manual() -> None:
    manual = (Path(__file__).parents[2] / "docs" / "api.md").read_text()
    for path, item in document()["paths"].items():
        for method in item:
            assert f"`{method.upper()} {path}`" in manual
