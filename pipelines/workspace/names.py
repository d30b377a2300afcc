"""Names in the configuration that stand for registered or user-supplied classes."""

from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from curate.detectors.devices import check_device_name
from curate.errors import ConfigError
from curate.files.onnx_providers import PROVIDERS, provider_named
from pipelines.registry import Registry


class _CheckedText:
    """Marks a text that a subclass checks; its ConfigError becomes an error of the setting."""

    def check(self, name: str) -> None:
        """Raise ConfigError if the name is not valid."""
        raise NotImplementedError

    def __get_pydantic_core_schema__(
        self, source: type[Any], handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def _checked(self, name: str) -> str:
        try:
            self.check(name)
        except ConfigError as error:  # pydantic collects ValueError
            raise ValueError(str(error)) from error
        return name


@dataclass(frozen=True)
class KnownName(_CheckedText):
    """Marks a text as the name of an extension, or as `module:Class`.

    A class is imported, and thereby checked, only by commands that use it.

    Attributes:
        registry: the registered extensions.
        others: further valid names, such as "none".
    """

    registry: Registry
    others: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The valid names."""
        return (*self.registry.classes, *self.others)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        choices = [{"enum": list(self.names)}, {"pattern": "^[^:]+:.+$"}]
        return {**handler(schema), "anyOf": choices}

    def check(self, name: str) -> None:
        """Raise ConfigError if the name is not valid."""
        self.registry.check_name(name, *self.others)


@dataclass(frozen=True)
class KnownClassSet(_CheckedText):
    """Marks a text as the name of a class set of segmenters."""

    @property
    def names(self) -> tuple[str, ...]:
        """The valid names. They are imported here because they need numpy."""
        from curate.segmenters.classes import CLASS_MAPS

        return tuple(CLASS_MAPS)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {**handler(schema), "enum": list(self.names)}

    def check(self, name: str) -> None:
        """Raise ConfigError if the name is not valid."""
        from curate.segmenters.classes import class_map

        class_map(name)


@dataclass(frozen=True)
class KnownProvider(_CheckedText):
    """Marks a text as the name of an execution provider of ONNX Runtime."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the known providers; ONNX Runtime's own names are valid, too."""
        return tuple(each.name for each in PROVIDERS)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        choices = [{"enum": list(self.names)}, {"pattern": "^[A-Za-z]+ExecutionProvider$"}]
        return {**handler(schema), "anyOf": choices}

    def check(self, name: str) -> None:
        """Raise ConfigError if the name is not valid."""
        provider_named(name)


@dataclass(frozen=True)
class KnownDevice(_CheckedText):
    """Marks a text as the name of a device of torch, or "auto"."""

    def check(self, name: str) -> None:
        """Raise ConfigError if the name is not valid."""
        check_device_name(name)
