"""Draws gaussians in versions of Blender that cannot draw splats.

A node group places an ellipsoid at each point, with radii of three standard deviations.
Its opacity is that of the gaussian at the point of the ray where it is largest, as in
Moenne-Loccoz et al., 3D Gaussian Ray Tracing (2024): in the frame of the gaussian, a
ray through p along the unit vector d has the squared distance p.p - (p.d)^2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bpy

NAME = "v3dg ellipsoids"
_RADIUS = 3.0  # in standard deviations; 1 % of the opacity is left there
_SUBDIVISIONS = 2  # subdivisions of an icosahedron, which then has 80 triangles


def material() -> bpy.types.Material:
    """Return the material of ellipsoids, and create it if the file has none."""
    if NAME in bpy.data.materials:
        return bpy.data.materials[NAME]
    result = bpy.data.materials.new(NAME)
    if result.node_tree is None:  # needed before Blender 5.0
        result.use_nodes = True
    tree = result.node_tree
    tree.nodes.clear()
    radiance = tree.nodes.new("ShaderNodeAttribute")
    radiance.attribute_type = "INSTANCER"
    radiance.attribute_name = "radiance"
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(radiance.outputs["Color"], emission.inputs["Color"])
    transparent = tree.nodes.new("ShaderNodeBsdfTransparent")
    mix = tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(_opacity(tree, radiance.outputs["Alpha"]), mix.inputs[0])
    tree.links.new(transparent.outputs[0], mix.inputs[1])
    tree.links.new(emission.outputs[0], mix.inputs[2])
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return result


def _opacity(tree: bpy.types.NodeTree, peak: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Return peak * exp(-distance^2 / 2) at the front of an ellipsoid, 0 at its back,
    so that each ray meets a gaussian once."""
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    geometry = tree.nodes.new("ShaderNodeNewGeometry")
    direction = tree.nodes.new("ShaderNodeVectorTransform")
    direction.vector_type = "VECTOR"
    direction.convert_from = "WORLD"
    direction.convert_to = "OBJECT"
    tree.links.new(geometry.outputs["Incoming"], direction.inputs[0])
    unit = _vector_math(tree, "NORMALIZE", direction.outputs[0])
    point = coordinates.outputs["Object"]
    squared = _vector_math(tree, "DOT_PRODUCT", point, point)
    depth = _vector_math(tree, "DOT_PRODUCT", point, unit)
    depth_squared = _math(tree, "MULTIPLY", depth, depth)
    distance_squared = _math(tree, "SUBTRACT", squared, depth_squared)
    exponent = _math(tree, "MULTIPLY", distance_squared, -0.5)
    falloff = _math(tree, "EXPONENT", exponent, 0.0)
    is_front = _math(tree, "SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    return _math(tree, "MULTIPLY", _math(tree, "MULTIPLY", peak, falloff), is_front)


def _math(
    tree: bpy.types.NodeTree,
    operation: str,
    first: bpy.types.NodeSocket | float,
    second: bpy.types.NodeSocket | float,
) -> bpy.types.NodeSocket:
    node = tree.nodes.new("ShaderNodeMath")
    node.operation = operation
    for number, value in enumerate((first, second)):
        if isinstance(value, float):
            node.inputs[number].default_value = value
        else:
            tree.links.new(value, node.inputs[number])
    return node.outputs[0]


def _vector_math(
    tree: bpy.types.NodeTree, operation: str, *vectors: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    node = tree.nodes.new("ShaderNodeVectorMath")
    node.operation = operation
    for number, value in enumerate(vectors):
        tree.links.new(value, node.inputs[number])
    if operation == "DOT_PRODUCT":
        return node.outputs["Value"]
    return node.outputs["Vector"]


def node_group() -> bpy.types.NodeTree:
    """Return the node group that places ellipsoids, and create it if the file has
    none."""
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    source = tree.nodes.new("NodeGroupInput")
    sphere = tree.nodes.new("GeometryNodeMeshIcoSphere")
    sphere.inputs["Radius"].default_value = _RADIUS
    sphere.inputs["Subdivisions"].default_value = _SUBDIVISIONS
    surface = tree.nodes.new("GeometryNodeSetMaterial")
    surface.inputs["Material"].default_value = material()
    tree.links.new(sphere.outputs["Mesh"], surface.inputs["Geometry"])
    instances = tree.nodes.new("GeometryNodeInstanceOnPoints")
    tree.links.new(source.outputs[0], instances.inputs["Points"])
    tree.links.new(surface.outputs[0], instances.inputs["Instance"])
    for name, kind, target in (
        ("rotation", "QUATERNION", "Rotation"),
        ("scale", "FLOAT_VECTOR", "Scale"),
    ):
        attribute = tree.nodes.new("GeometryNodeInputNamedAttribute")
        attribute.data_type = kind
        attribute.inputs["Name"].default_value = name
        tree.links.new(attribute.outputs["Attribute"], instances.inputs[target])
    result = tree.nodes.new("NodeGroupOutput")
    tree.links.new(instances.outputs[0], result.inputs[0])
    return tree


def add_modifier(target: bpy.types.Object) -> None:
    """Draw the points of a mesh object as ellipsoids."""
    modifier = target.modifiers.new(NAME, "NODES")
    modifier.node_group = node_group()


@contextmanager
def hidden(targets: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Draw no ellipsoids inside the context, so that a dependency graph contains copies
    of mesh objects and not of their ellipsoids."""
    modifiers = [target.modifiers[NAME] for target in targets if NAME in target.modifiers]
    visible = [modifier for modifier in modifiers if modifier.show_viewport]
    for modifier in visible:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in visible:
            modifier.show_viewport = True
