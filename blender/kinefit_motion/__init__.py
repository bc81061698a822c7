"""Blender add-on: motions of kinefit (`kinefit export --to jsonl`) as armatures, with their uncertainty.

*File, Import, kinefit motion (.jsonl)* makes an armature that moves as the person did. Every bone has three custom
properties with a curve each: `kinefit_std_mm`, one standard deviation of its joint along the longest axis (-1 where
nothing observes it), `kinefit_quality` (0 to 1) and `kinefit_lost`. *Object, Animation, Retarget kinefit motion* puts
the motion of the imported armature onto the active one.
"""

bl_info = {
    "name": "kinefit motion", "author": "The kinefit authors", "version": (0, 2, 0), "blender": (4, 2, 0),
    "location": "File > Import", "description": "Motions of kinefit with their uncertainty", "category": "Animation",
}

import bpy  # noqa: E402
from bpy.props import StringProperty  # noqa: E402
from bpy_extras.io_utils import ImportHelper  # noqa: E402

from . import figure, onto  # noqa: E402
from .lines import LinesError, read_lines  # noqa: E402


class ImportKinefit(bpy.types.Operator, ImportHelper):
    """Import a motion of kinefit, with its uncertainty."""

    bl_idname = "import_anim.kinefit"
    bl_label = "Import kinefit motion"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    filename_ext = ".jsonl"
    filter_glob: StringProperty(default="*.jsonl", options={"HIDDEN"})

    def execute(self, context):
        try:
            motion = read_lines(self.filepath)
        except LinesError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        figure.build(motion, context, self.filepath)
        self.report({"INFO"}, f"{len(motion.times)} frames of {motion.name}")
        return {"FINISHED"}


class RetargetKinefit(bpy.types.Operator):
    """Put the motion of the selected kinefit armature onto the active armature."""

    bl_idname = "object.kinefit_retarget"
    bl_label = "Retarget kinefit motion"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context):
        return context.active_object is not None and context.active_object.type == "ARMATURE"

    def execute(self, context):
        target = context.active_object
        sources = [o for o in context.selected_objects if o is not target and figure.PATH in o]
        if len(sources) != 1:
            self.report({"ERROR"}, "Select one armature that was imported from kinefit, and then your own.")
            return {"CANCELLED"}
        try:
            count = onto.retarget(read_lines(sources[0][figure.PATH]), target, context)
        except (LinesError, onto.NamesError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count} bones follow the motion")
        return {"FINISHED"}


def _import_entry(menu, context):
    menu.layout.operator(ImportKinefit.bl_idname, text="kinefit motion (.jsonl)")


def _object_entry(menu, context):
    menu.layout.operator(RetargetKinefit.bl_idname)


def register():
    for kind in (ImportKinefit, RetargetKinefit):
        bpy.utils.register_class(kind)
    bpy.types.TOPBAR_MT_file_import.append(_import_entry)
    bpy.types.VIEW3D_MT_object_animation.append(_object_entry)


def unregister():
    bpy.types.VIEW3D_MT_object_animation.remove(_object_entry)
    bpy.types.TOPBAR_MT_file_import.remove(_import_entry)
    for kind in (RetargetKinefit, ImportKinefit):
        bpy.utils.unregister_class(kind)
