"""Adapters for simulators. Each module needs the package of its simulator, which is
installed separately; docs/simulators.md describes them."""
