"""Build the scene of this folder in Blender 4.2 or newer: the clip's camera, its pictures behind it, and its points.

    blender --python scene.py                                     opens Blender with the scene
    blender --background --python scene.py -- clip.blend          saves it as a file

Or in Blender: the workspace Scripting, Open, Run Script. What was open before stays: the clip is a scene of its own.
A frame of the scene is a frame of the clip, from 1 on. Needs no add-on and no other package. `vggtjax export
--to blender` writes this file beside scene.json, pictures/, static.ply and moving/, and it works only there.
"""

from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np
from mathutils import Matrix  # pyright: ignore[reportMissingImports]

SENSOR = 36.0  # millimetres
WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, y down, z forward -> x right, y forward, z up
CAMERA = np.diag([1, -1, -1])  # Blender's cameras look along -z, y up
LEVELS = np.arange(256) / 255  # of sRGB
LINEAR = np.where(LEVELS <= 0.04045, LEVELS / 12.92, ((LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
TINT = "tint"  # an attribute named color is black in Cycles of Blender 5.0
VERTEX = np.dtype([("points", "<f4", 3), ("colors", "u1", 4)])


def main():
    folder = this_folder()
    facts = json.loads((folder / "scene.json").read_text("utf-8"))
    scene = bpy.data.scenes.new(facts["name"])
    set_up(scene, facts)
    add_camera(scene, folder, facts)
    style = point_style(facts["point_radius"])
    add_points(scene.collection, "static", folder / "static.ply", style)
    moving = bpy.data.collections.new("moving")
    scene.collection.children.link(moving)
    for number in range(1, len(facts["frames"]) + 1) if (folder / "moving").is_dir() else ():
        points = add_points(moving, f"moving_{number:06d}", folder / f"moving/{number:06d}.ply", style)
        show_only_at(points, number)
    scene.frame_set(1)
    show(scene)
    if "--" in sys.argv[:-1]:
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(sys.argv[sys.argv.index("--") + 1]).absolute()))


def this_folder():
    text = getattr(bpy.context.space_data, "text", None)  # of the text editor, where __file__ is no path
    path = text.filepath if text and text.filepath else __file__
    return Path(bpy.path.abspath(path)).absolute().parent


def set_up(scene, facts):
    render = scene.render
    render.resolution_x, render.resolution_y = facts["width"], facts["height"]
    render.fps = max(1, round(facts["frames_a_second"]))
    render.fps_base = render.fps / facts["frames_a_second"]
    tall = pixel_shape(facts)
    render.pixel_aspect_x, render.pixel_aspect_y = max(1, 1 / tall), max(1, tall)  # Blender takes 1 and above
    scene.frame_start, scene.frame_end = 1, len(facts["frames"])
    scene.view_settings.view_transform = "Standard"  # the pictures' colours as they are


def pixel_shape(facts):
    """Return the height of a pixel over its width: the median of the frames, as Blender does not animate it."""
    return float(np.median([frame["fl_x"] / frame["fl_y"] for frame in facts["frames"]]))


def add_camera(scene, folder, facts):
    data = bpy.data.cameras.new("camera")
    camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.rotation_mode = "QUATERNION"
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.clip_start, data.clip_end = facts["near"], facts["far"]
    width, height, tall = facts["width"], facts["height"], pixel_shape(facts)
    turn = None
    for number, frame in enumerate(facts["frames"], start=1):
        pose = np.array(frame["world_from_camera"])
        camera.location = WORLD @ pose[:3, 3]
        rotation = Matrix((WORLD @ pose[:3, :3] @ CAMERA).tolist()).to_quaternion()
        if turn is not None:
            rotation.make_compatible(turn)
        camera.rotation_quaternion = turn = rotation
        data.lens = (frame["fl_x"] * frame["fl_y"] * tall) ** 0.5 / width * SENSOR
        data.shift_x = 0.5 - frame["cx"] / width
        data.shift_y = (frame["cy"] / height - 0.5) * height * tall / width
        for owner, name in ((camera, "location"), (camera, "rotation_quaternion")):
            owner.keyframe_insert(name, frame=number)
        for name in ("lens", "shift_x", "shift_y"):
            data.keyframe_insert(name, frame=number)
    add_pictures(data, folder / facts["frames"][0]["picture"], len(facts["frames"]))


def add_pictures(data, first, count):
    image = bpy.data.images.load(str(first))
    image.source = "SEQUENCE"  # Blender counts the digits of the first name on
    background = data.background_images.new()
    background.image, background.alpha, background.frame_method = image, 1.0, "STRETCH"
    user = background.image_user
    user.frame_start, user.frame_duration, user.frame_offset = 1, count, 0
    user.use_auto_refresh = True
    data.show_background_images = True


def add_points(collection, name, path, style):
    points, colors = read_ply(path)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(points @ WORLD.T, np.float32).ravel())
    attribute = mesh.color_attributes.new(TINT, "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", LINEAR[colors].ravel())
    mesh.update()
    owner = bpy.data.objects.new(name, mesh)
    collection.objects.link(owner)
    owner.modifiers.new("points", "NODES").node_group = style
    return owner


def read_ply(path):
    """Return points [N, 3] and colours [N, 4] of a file that vggtjax wrote."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    count = int(header.split(b"element vertex ")[1].split()[0])
    vertices = np.frombuffer(body, VERTEX, count)
    return vertices["points"], vertices["colors"]


def show_only_at(owner, number):
    for frame, hidden in ((number - 1, True), (number, False), (number + 1, True)):
        owner.hide_viewport = owner.hide_render = hidden
        for name in ("hide_viewport", "hide_render"):
            owner.keyframe_insert(name, frame=frame)


def point_style(radius):
    """Return the geometry nodes that make a small ball in its own colour of each vertex."""
    material = bpy.data.materials.new("point")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    color, light = tree.nodes.new("ShaderNodeAttribute"), tree.nodes.new("ShaderNodeEmission")
    color.attribute_name = TINT
    tree.links.new(color.outputs["Color"], light.inputs["Color"])
    tree.links.new(light.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])

    group = bpy.data.node_groups.new("points", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    names = ("NodeGroupInput", "GeometryNodeMeshToPoints", "GeometryNodeSetMaterial", "NodeGroupOutput")
    chain = [group.nodes.new(name) for name in names]
    for before, after in pairwise(chain):
        group.links.new(before.outputs[0], after.inputs[0])
    chain[1].inputs["Radius"].default_value = radius
    chain[2].inputs["Material"].default_value = material
    return group


def show(scene):
    """Make the scene the one that is seen, through its camera and in colour."""
    window = bpy.context.window
    if window is None:
        return
    window.scene = scene
    for area in window.screen.areas:
        if area.type == "VIEW_3D":
            area.spaces[0].shading.type = "MATERIAL"
            area.spaces[0].region_3d.view_perspective = "CAMERA"


if __name__ == "__main__":
    main()
