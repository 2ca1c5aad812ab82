"""Descriptions of keys from the schema: the JSON Schema for editors, texts of messages and the table of the guide."""

from __future__ import annotations

import functools
import json
import re
from typing import Any, NamedTuple

from pydantic.json_schema import GenerateJsonSchema

from mpitled.deck.schema import DEFAULT_LAW, Deck
from mpitled.laws import LAWS

#: The JSON Schema of a key or a section, with the additional entry "unit".
Schema = dict[str, Any]


class _Draft7(GenerateJsonSchema):
    """pydantic's JSON Schema in the draft that Taplo reads, without null, which TOML lacks."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def nullable_schema(self, schema: Any) -> Schema:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Schema:
        return self.generate_inner(schema["schema"])  # `key` adds the default in the deck's unit

    def tuple_schema(self, schema: Any) -> Schema:
        array = super().tuple_schema(schema)
        return array | {"items": array.pop("prefixItems")[0]} if "prefixItems" in array else array


class Home(NamedTuple):
    """A section. Materials have one for their common keys, and one for the keys of each law."""

    section: str
    heading: str  # in a deck: "[labels]", "[material.NAME]", "[[fixed]]"; "" at the top
    schema: Schema
    law: str = ""

    @property
    def keys(self) -> dict[str, Schema]:
        """The keys by name. The default of a key is in the deck's unit."""
        return {name: key for name, key in self.schema["properties"].items() if "unit" in key}

    @property
    def about(self) -> str:
        """The meaning of the section."""
        return str(self.schema["description"]).partition("\n\n")[0]

    @property
    def depth(self) -> int:
        """Number of parts in the full name of a key: 1 in title, 2 in labels.image, 3 in fixed.0.nodes."""
        return 1 + bool(self.section) + (self.heading.startswith("[[") or ".NAME" in self.heading)


@functools.cache
def homes() -> tuple[Home, ...]:
    """The top of the deck, and every section in the order of the guide."""
    schema = Deck.model_json_schema(ref_template="{model}", schema_generator=_Draft7)
    all_homes = [Home("", "", schema)]
    for name, node in schema["properties"].items():
        repeated, named = node.get("items"), node.get("additionalProperties")
        heading = f"[[{name}]]" if repeated else f"[{name}.NAME]" if named else f"[{name}]"
        if reference := (repeated or named or node).get("$ref"):
            all_homes.append(Home(name, heading, schema["$defs"][reference]))
        if name == "material":
            all_homes += [Home(name, f'{heading} law = "{law}"', _law_schema(law), law) for law in LAWS]
    return tuple(all_homes)


def _law_schema(law: str) -> Schema:
    return LAWS[law].model_json_schema(schema_generator=_Draft7)


def keys_of(section: str, law: Any = DEFAULT_LAW) -> dict[str, Schema]:
    """The keys of a section by name. A material has the common keys and the keys of its law."""
    parts = (home.keys for home in homes() if home.section == section and home.law in ("", law))
    return {name: key for keys in parts for name, key in keys.items()}


def json_schema() -> Schema:
    """The JSON Schema (draft 7) of a deck. Editors with Taplo use it to complete, explain and check keys."""
    schema = Deck.model_json_schema(ref_template="#/definitions/{model}", schema_generator=_Draft7)
    definitions = schema["definitions"] = schema.pop("$defs")
    material, laws = definitions["MaterialSection"], []
    for law in LAWS:
        parameters = _law_schema(law)
        keys = {"law": {**material["properties"]["law"], "enum": [law]}} | parameters["properties"]
        keys = material["properties"] | keys
        required = parameters.get("required", []) + ([] if law == DEFAULT_LAW else ["law"])
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
    """The valid values of a key: "a list of 3 numbers above 0, in mm"."""
    if unit := key.get("unit"):
        return f"{expected(key | {'unit': ''})}, in {unit}"
    if "anyOf" in key:
        return " or ".join(map(expected, key["anyOf"]))
    if values := choices(key):
        return " or ".join(map(shown, values))
    if key["type"] == "array":
        count = f"{key['minItems']} " if key.get("minItems", 0) == key.get("maxItems") else ""
        entry = re.sub(r"^an? (\w+)", rf"{count}\1s", expected(key["items"]))
        return f"a list of {entry}" + ("" if "minItems" in key else ", or [] for none")
    if key.get("format") == "path":
        return "a path relative to the deck's folder"
    limits = [f"{word} {key[limit]:g}" for limit, word in _LIMITS.items() if key.get(limit, 2**31) < 2**31]
    return f"{_TYPES[key['type']]} {' and '.join(limits)}".strip()


def choices(key: Schema) -> list[Any]:
    """The values of a key with an enumeration; empty for other keys."""
    return key.get("enum") or ([key["const"]] if "const" in key else [])


def shown(value: Any) -> str:
    """A value as one line of at most 60 characters."""
    return shorten(json.dumps(value, ensure_ascii=False, default=str))


def shorten(text: str) -> str:
    """The text, cut to 60 characters."""
    return text if len(text) <= 60 else f"{text[:57]}..."


def unit_of(name: str) -> str:
    """Unit of the key "section.key" in a deck; "" for a key without a unit and for an unknown key."""
    section, _, key = name.rpartition(".")
    schemas = (home.keys.get(key, {}) for home in homes() if home.section == section.partition(".")[0])
    return next((str(schema["unit"]) for schema in schemas if schema), "")


def markdown_table() -> str:
    """The table of all keys in the guide, jobs/README.md."""
    lines = ["| key | value | unit | default | meaning |", "|---|---|---|---|---|"]
    for home in homes():
        lines += [f"| **`{home.heading}`** | | | | {home.about} |"] if home.heading else []
        for name, key in home.keys.items():
            value = expected(key | {"unit": ""}).removeprefix("a list of ")
            required = "required" if name in home.schema.get("required", ()) else ""
            default = f"`{shown(key['default'])}`" if "default" in key else required
            lines.append(f"| `{name}` | {value} | {key['unit']} | {default} | {key['description']} |")
    return "\n".join(lines) + "\n"
