"""Adapters for simulators. Each module needs the package of its simulator, which must
be installed separately. docs/simulators.md describes them."""
