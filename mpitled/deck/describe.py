"""What the schema says about keys: the JSON Schema for editors, the words of messages and the table of the guide."""

from __future__ import annotations

import functools
import json
import re
from typing import Any, NamedTuple

from pydantic.json_schema import GenerateJsonSchema

from mpitled.deck.schema import DEFAULT_LAW, Deck
from mpitled.laws import LAWS

#: A key or a section as JSON Schema describes it, with our entry "unit".
Schema = dict[str, Any]


class _Draft7(GenerateJsonSchema):
    """pydantic's JSON Schema in the draft that Taplo reads, without null, which TOML does not have."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def nullable_schema(self, schema: Any) -> Schema:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Schema:
        return self.generate_inner(schema["schema"])  # `key` adds the default in the deck's unit

    def tuple_schema(self, schema: Any) -> Schema:
        made = super().tuple_schema(schema)
        return made | {"items": made.pop("prefixItems")[0]} if "prefixItems" in made else made


class Home(NamedTuple):
    """A section. Each law is a home of its own beside the home of the keys that all materials have."""

    section: str
    heading: str  # as a deck has it: "[labels]", "[material.NAME]", "[[fixed]]"; "" at the top
    schema: Schema
    law: str = ""

    @property
    def keys(self) -> dict[str, Schema]:
        """The keys by name. The default of a key is in the deck's unit."""
        return {name: key for name, key in self.schema["properties"].items() if "unit" in key}

    @property
    def about(self) -> str:
        """What the section is."""
        return str(self.schema["description"]).partition("\n\n")[0]

    @property
    def depth(self) -> int:
        """Number of parts of the full name of a key: 1 of title, 2 of labels.image, 3 of fixed.0.nodes."""
        return 1 + bool(self.section) + (self.heading.startswith("[[") or ".NAME" in self.heading)


@functools.cache
def homes() -> tuple[Home, ...]:
    """The top of the deck, and every section in the order of the guide."""
    schema = Deck.model_json_schema(ref_template="{model}", schema_generator=_Draft7)
    found = [Home("", "", schema)]
    for name, node in schema["properties"].items():
        several, named = node.get("items"), node.get("additionalProperties")
        heading = f"[[{name}]]" if several else f"[{name}.NAME]" if named else f"[{name}]"
        if reference := (several or named or node).get("$ref"):
            found.append(Home(name, heading, schema["$defs"][reference]))
        if name == "material":
            for law, model in LAWS.items():
                own = model.model_json_schema(schema_generator=_Draft7)
                found.append(Home(name, f'{heading} law = "{law}"', own, law))
    return tuple(found)


def keys_of(section: str, law: Any = DEFAULT_LAW) -> dict[str, Schema]:
    """The keys of a section by name; of a material, those that all materials have and those of its law."""
    own = (home.keys for home in homes() if home.section == section and home.law in ("", law))
    return {name: key for keys in own for name, key in keys.items()}


def json_schema() -> Schema:
    """The JSON Schema of a deck (draft 7), from which editors with Taplo complete, explain and check keys."""
    schema = Deck.model_json_schema(ref_template="#/definitions/{model}", schema_generator=_Draft7)
    definitions = schema["definitions"] = schema.pop("$defs")
    material, laws = definitions["MaterialSection"], []
    for law, model in LAWS.items():
        own = model.model_json_schema(schema_generator=_Draft7)
        keys = material["properties"] | {"law": {**material["properties"]["law"], "enum": [law]}} | own["properties"]
        required = own.get("required", []) + ([] if law == DEFAULT_LAW else ["law"])
        laws.append(material | {"properties": keys, "required": required})
    for section in (*definitions.values(), *laws):
        for name, key in section["properties"].items():
            unit = f", in {key['unit']}" if key.get("unit") else ""
            section["properties"][name] = {**key, "description": key["description"] + unit}
    definitions["MaterialSection"] = {"anyOf": laws}
    return {"$schema": "http://json-schema.org/draft-07/schema#", **schema}


# --- words ---------------------------------------------------------------------------------------------------------

_LIMITS = {"exclusiveMinimum": "above", "minimum": "at least", "exclusiveMaximum": "below", "maximum": "at most"}
_TYPES = {"boolean": "true or false", "integer": "an integer", "number": "a number", "string": "a string"}


def expected(key: Schema) -> str:
    """What to give for a key: "a list of 3 numbers above 0, in mm"."""
    if unit := key.get("unit"):
        return f"{expected(key | {'unit': ''})}, in {unit}"
    if "anyOf" in key:
        return " or ".join(map(expected, key["anyOf"]))
    if listed := choices(key):
        return " or ".join(map(shown, listed))
    if key["type"] == "array":
        count = f"{key['minItems']} " if key.get("minItems", 0) == key.get("maxItems") else ""
        entry = re.sub(r"^an? (\w+)", rf"{count}\1s", expected(key["items"]))
        return f"a list of {entry}" + ("" if "minItems" in key else ", or [] for none")
    if key.get("format") == "path":
        return "a path relative to the deck's folder"
    limits = [f"{word} {key[limit]:g}" for limit, word in _LIMITS.items() if key.get(limit, 2**31) < 2**31]
    return f"{_TYPES[key['type']]} {' and '.join(limits)}".strip()


def choices(key: Schema) -> list[Any]:
    """The values of a key that offers a few."""
    return key.get("enum") or ([key["const"]] if "const" in key else [])


def shown(value: Any) -> str:
    """A value in one line of at most 60 characters."""
    return shorten(json.dumps(value, ensure_ascii=False, default=str))


def shorten(text: str) -> str:
    """At most 60 characters of a text."""
    return text if len(text) <= 60 else f"{text[:57]}..."


def unit_of(name: str) -> str:
    """Unit of the key "section.key" in a deck; "" if it has none, or there is no such key."""
    section, _, written = name.rpartition(".")
    found = (
        home.keys[written] for home in homes() if home.section == section.partition(".")[0] and written in home.keys
    )
    return str(next(found, {}).get("unit", ""))


def markdown_table() -> str:
    """The table of all keys for the guide, jobs/README.md."""
    lines = ["| key | value | unit | default | meaning |", "|---|---|---|---|---|"]
    for home in homes():
        lines += [f"| **`{home.heading}`** | | | | {home.about} |"] if home.heading else []
        for name, key in home.keys.items():
            value = expected(key | {"unit": ""}).removeprefix("a list of ")
            required = "required" if name in home.schema.get("required", ()) else ""
            default = f"`{shown(key['default'])}`" if "default" in key else required
            lines.append(f"| `{name}` | {value} | {key['unit']} | {default} | {key['description']} |")
    return "\n".join(lines) + "\n"
