# SPDX-License-Identifier: Apache-2.0
"""The API's own description, OpenAPI 3.1: what every path takes and gives.

Tests hold it against the routes that are served and against real answers.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

from avckpt import __version__
from avckpt.containers.protected import State
from avckpt.events.record import EventRecord, field_types
from avckpt.evidence.crash import Crash

Json = dict[str, Any]

_TIME = {"type": "number", "description": "seconds since 1970"}


def document() -> Json:
    """The whole document."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "avckpt sidecar",
            "version": __version__,
            "description": "HTTP on the Unix socket /run/avckpt/api.sock, for root only.",
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
        },
        "servers": [{"url": "http://localhost", "description": "any host name: there is only the socket"}],
        "paths": _PATHS,
        "components": {
            "schemas": {
                "Container": _container(),
                "Event": _event(),
                "Error": _ERROR,
                "Crash": _crash(),
                "Generation": _GENERATION,
                "Configuration": _CONFIGURATION,
            },
            "responses": {
                "Error": {
                    "description": "what went wrong",
                    "content": {
                        "application/json": {
                            "schema": _object({"error": _ref("Error")}),
                        }
                    },
                }
            },
        },
    }


def _ref(name: str) -> Json:
    return {"$ref": f"#/components/schemas/{name}"}


def _object(properties: Json, optional: tuple[str, ...] = ()) -> Json:
    return {
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in optional],
        "additionalProperties": False,
    }


def _array(items: Json) -> Json:
    return {"type": "array", "items": items}


def _text(description: str) -> Json:
    return {"type": "string", "description": description}


def _integer(description: str) -> Json:
    return {"type": "integer", "minimum": 0, "description": description}


def _seconds(description: str) -> Json:
    return {"type": "number", "minimum": 0, "description": description}


def _or_null(schema: Json) -> Json:
    return {**schema, "type": [schema["type"], "null"]}


def _container() -> Json:
    at, s = _or_null(_TIME), _or_null(_seconds("seconds"))
    return _object(
        {
            "id": _text("64 hex digits"),
            "name": _text("as Podman has it"),
            "group": _text("avckpt.group, empty: none"),
            "line": _integer("of the group, that this generation is part of; 0: of none"),
            "node_of": _text("id of the container in which it is a node; host; empty: it is a container"),
            "state": {"type": "string", "enum": [state.value for state in State]},
            "reason": _text("why it is not (quite) protected, or how it ended; empty when all is well"),
            "init_pid": _integer("avckpt-init, in the sidecar's PID namespace"),
            "app_pid": _integer("the application, in the sidecar's PID namespace; 0: none yet"),
            "app_pid_inside": _integer("the same in the container's"),
            "guard_pid": _integer("of the process that protects it, in the sidecar's PID namespace; 0: there is none"),
            "threads": _integer("of the last checkpoint or restore"),
            "interval_s": _seconds("between checkpoints, at present"),
            "automatic": {"type": "boolean", "description": "whether avckpt.interval=auto finds out that interval"},
            "keep": _integer("generations kept"),
            "generation": _integer("number of the newest, or of the one restored last"),
            "generations": _integer("held now"),
            "checkpoints": _integer("taken"),
            "missed": _integer("not taken"),
            "restores": _integer("so far"),
            "attempt": _integer("restores within the time of avckpt.restore.max, at the last one"),
            "restore_max": _integer("restores allowed within that time"),
            "dropped": _integer("generations given up before their time"),
            "last_dropped": _text("which, and why; empty: none"),
            "memory_bytes": _integer("memory that its generations hold and the application does not use, now"),
            "last_checkpoint_at": at,
            "last_freeze_s": s,
            "last_images": _text("how the last checkpoint got the memory: fork or dirty; empty: there was no choice"),
            "last_fork_reason": _text("why it was forked all the same; empty: it was not, or is small"),
            "last_quiescent": {"type": ["boolean", "null"]},
            "last_death": _text("in words; empty: none"),
            "last_death_at": at,
            "last_restore_s": s,
            "last_restore_age_s": s,
            "adopted": {"type": "boolean", "description": "it ran already when the sidecar started"},
            "registered_at": _TIME,
            "ended_at": at,
        }
    )


_ERROR = _object(
    {
        "kind": _text("stable, for programs: no_such_container, unprotected, empty, deadline, bad_request, ..."),
        "message": _text("one line for a person"),
        "detail": _text("the clause of it that says what"),
        "operation": _text("what was being done"),
        "syscall": _text("the call that failed"),
        "errno": {"type": "integer", "description": "the errno behind it, 0: none"},
        "pid": {"type": "integer", "description": "whom it happened to, 0: nobody"},
        "undo_failures": _integer("steps that could not be undone afterwards"),
        "container": _text("how to call the container"),
    }
)

_GENERATION = _object(
    {
        "generation": _integer("its number"),
        "age_s": _seconds("since it was taken"),
        "freeze_s": _seconds("how long the application stood still for it"),
        "threads": _integer("in it"),
        "crashes": _integer("soon after a restore from it, or from what it was taken from"),
    }
)

_CONFIGURATION = _object(
    {
        "path": _text("the file with the defaults for all containers"),
        "found": {"type": "boolean", "description": "whether there was such a file"},
        "loaded_at": _or_null(_TIME),
        "problem": _text("why the file as it is now was refused; empty: it is in force"),
    }
)


_RELOADED = _object(
    {
        "container": _text("its name"),
        "changes": _array(
            _object(
                {
                    "setting": _text("a label without its prefix"),
                    "before": _text("as in a label; empty: none"),
                    "after": _text("the same, now"),
                }
            )
        ),
        "problem": _text("why it goes on as before; empty: it does not"),
    }
)


def _event() -> Json:
    """From EventRecord itself."""
    types = field_types()
    properties: Json = {}
    for each in fields(EventRecord):
        schema = _schema_of(types[each.name], each.metadata["values"])
        if "$ref" not in schema:
            schema["description"] = each.metadata["description"]
        properties[each.name] = schema
    properties["message"] = _text("one line for a person, without the container's name")
    always = ("kind", "container", "id", "group", "at", "monotonic_s", "seq", "detail", "message")
    return _object(properties, optional=tuple(name for name in properties if name not in always))


def _crash() -> Json:
    properties: Json = {
        each.name: {**_schema_of(type(each.default)), "description": each.metadata["description"]}
        for each in fields(Crash)
    }
    return _object(properties, optional=tuple(properties))


def _schema_of(kind: type, values: Iterable[enum.Enum] = ()) -> Json:
    if issubclass(kind, enum.Enum):
        return {"type": "string", "enum": [member.value for member in values or kind]}
    names = {bool: "boolean", int: "integer", float: "number", str: "string"}
    return {"type": names[kind]} if kind in names else _ref("Crash" if kind is Crash else "Error")


def _answer(description: str, schema: Json, media_type: str = "application/json") -> Json:
    return {
        "200": {"description": description, "content": {media_type: {"schema": schema}}},
        "default": {"$ref": "#/components/responses/Error"},
    }


def _query(name: str, schema: Json, description: str) -> Json:
    return {"name": name, "in": "query", "required": False, "schema": schema, "description": description}


_AFTER = _query("after", {"type": "integer", "minimum": 0}, "only events with a greater seq")
_SINCE = _query("since", {"type": "number"}, "only events at or after this time of day, seconds since 1970")
_COMMAND_ANSWER = _object({"container": _ref("Container"), "event": _ref("Event")})


_NAME = {
    "name": "name",
    "in": "path",
    "required": True,
    "schema": {"type": "string"},
    "description": "name, id or unique id prefix",
}


def _command(verb: str, summary: str, *parameters: Json) -> Json:
    return {
        "post": {
            "operationId": verb,
            "summary": summary,
            "parameters": [_NAME, *parameters],
            "responses": _answer("done", _COMMAND_ANSWER),
        }
    }


_PATHS: Json = {
    "/v1/info": {
        "get": {
            "operationId": "info",
            "summary": "Who the sidecar is",
            "responses": _answer(
                "the sidecar",
                _object(
                    {
                        "version": _text("of the sidecar"),
                        "native_version": _text("of its native library"),
                        "pid": _integer("in its own PID namespace"),
                        "started_at": _TIME,
                        "containers": _integer("known now"),
                        "config": _ref("Configuration"),
                    }
                ),
            ),
        }
    },
    "/v1/containers": {
        "get": {
            "operationId": "containers",
            "summary": "Protected containers",
            "parameters": [
                _query("all", {"type": "boolean"}, "also the last few that have ended"),
                _query(
                    "memory",
                    {"type": "boolean", "default": True},
                    "0: memory_bytes as somebody last saw it, 0 if nobody has; to look takes milliseconds for each GB",
                ),
            ],
            "responses": _answer("oldest first", _object({"containers": _array(_ref("Container"))})),
        }
    },
    "/v1/containers/{name}": {
        "get": {
            "operationId": "inspect",
            "summary": "All that is known of a container",
            "parameters": [_NAME],
            "responses": _answer(
                "the container",
                _object(
                    {
                        "container": _ref("Container"),
                        "settings": {
                            "type": "object",
                            "additionalProperties": {"type": "string"},
                            "description": "every label without its prefix, as it is in force",
                        },
                        "generations": _array(_ref("Generation")),
                        "crashes": _array(_ref("Event")),
                    }
                ),
            ),
        }
    },
    "/v1/containers/{name}/checkpoint": _command("checkpoint", "Take a checkpoint now"),
    "/v1/containers/{name}/restore": _command(
        "restore",
        "Roll a running container back to a checkpoint",
        _query(
            "generation", {"type": "integer", "minimum": 0}, "its number; those after it are given up; 0: the newest"
        ),
    ),
    "/v1/reload": {
        "post": {
            "operationId": "reload",
            "summary": "Read the configuration file again",
            "responses": _answer(
                "it is in force; containers that run and for which something changed, or should have",
                _object({"config": _ref("Configuration"), "containers": _array(_RELOADED)}),
            ),
        }
    },
    "/v1/events": {
        "get": {
            "operationId": "events",
            "summary": "Follow events",
            "description": "Server-sent events: first those that are kept, then those that come, until either end "
            "closes. Each `data` is an Event, each `id` its seq: who connects again with Last-Event-ID misses "
            "nothing that is kept. Routine events (seq 0) have no id and are told once.",
            "parameters": [
                _AFTER,
                _SINCE,
                _query("all", {"type": "boolean"}, "also routine events, as every single checkpoint"),
                {
                    "name": "Last-Event-ID",
                    "in": "header",
                    "required": False,
                    "schema": {"type": "integer", "minimum": 0},
                    "description": "as `after`",
                },
            ],
            "responses": _answer("the stream", {"type": "string"}, "text/event-stream"),
        }
    },
    "/v1/history": {
        "get": {
            "operationId": "history",
            "summary": "The events that are kept, also from before a restart of the sidecar",
            "parameters": [_AFTER, _SINCE],
            "responses": _answer("oldest first", _object({"events": _array(_ref("Event"))})),
        }
    },
    "/v1/openapi.json": {
        "get": {
            "operationId": "openapi",
            "summary": "This document",
            "responses": _answer("this document", {"type": "object"}),
        }
    },
    "/metrics": {
        "get": {
            "operationId": "metrics",
            "summary": "Metrics for Prometheus",
            "responses": _answer("text format", {"type": "string"}, "text/plain"),
        }
    },
}
