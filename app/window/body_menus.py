"""Context menus of the view, the sliders and the rows of body parts."""

from __future__ import annotations

from functools import partial

from PySide6.QtCore import QObject, QPoint, Qt, Slot
from PySide6.QtWidgets import QMenu

from app.view.shading import Shading
from app.window.command import EditorWindow
from app.window.commands.edit import copy_pose, edit_parts, paste_pose
from app.window.widgets import ListMenu
from lcollision_core.tasks.words import heading, menu_text

_RADII = {"&Small": 0.015, "&Medium": 0.03, "&Large": 0.06, "&Very large": 0.12}
"""Radii of the dragged patch, in normalised length."""


class BodyMenus(QObject):
    """Open the context menus of body parts and sliders.

    Parameters
    ----------
    window : parent of the menus, which act on it
    """

    def __init__(self, window: EditorWindow) -> None:
        super().__init__(window)
        self._window, self._document = window, window.document
        self._viewport, self._sliders = window.viewport, window.sliders
        self._actions = window.commands.actions
        self._colour_by = QMenu("C&olour by", window)
        self._colour_by.addActions([self._actions[shading.name.lower()] for shading in Shading])
        self._viewport.menu_wanted.connect(self.open_on_body)

    @Slot(object, object, QPoint)
    def open_on_body(self, domain: int | None, vertex: int | None, position: QPoint) -> None:
        """Open the menu of the body part under the pointer, and highlight the part meanwhile.

        Parameters
        ----------
        domain : index from 0, None beside the body
        vertex : under the pointer, None beside the body
        position : on the screen
        """
        actions = self._actions
        menu = self._new_menu()
        if vertex is not None:
            self._add_hold(menu, vertex)
        if domain is not None:
            self._fill(menu, domain, None)
            menu.addSeparator()
            self._viewport.highlight_domain(domain)
            menu.aboutToHide.connect(partial(self._viewport.highlight_domain, None))
        # Add submenus by their actions: one added as a menu is deleted with the first menu closed.
        shared = (self._colour_by, self._window.commands.submenus["&Camera view"])
        menu.addActions([submenu.menuAction() for submenu in shared])
        menu.addActions([actions["reset_camera"], actions["ghost"]])
        menu.addSeparator()
        menu.addActions([actions[key] for key in ("resolve", "reset", "undo")])
        menu.popup(position)

    @Slot(object, object, QPoint)
    def open_on_part(self, domain: int | None, code: int | None, position: QPoint) -> None:
        """Open the menu of a code or a domain, or of the whole body if both are None."""
        self.part_menu(domain, code).popup(position)

    def part_menu(self, domain: int | None, code: int | None) -> ListMenu:
        """Make a menu that deletes itself when it is closed.

        Parameters
        ----------
        domain : index from 0, None for the whole body
        code : index from 0 in the latent, None for the body part alone
        """
        menu = self._new_menu()
        self._fill(menu, domain, code)
        return menu

    def _add_hold(self, menu: ListMenu, vertex: int) -> None:
        """Add the entries for a vertex: pins, its limb, its mesh and the patch size."""
        document = self._document
        is_pinned = document.pins.has(vertex)
        menu.entry("Un&pin" if is_pinned else "&Pin", document.pins.toggle, vertex)
        if not is_pinned:
            menu.entry("Pin with &orientation", document.pins.toggle, vertex, True)
        menu.addAction(self._actions["unpin_all"])
        menu.addSeparator()
        menu.entry("Cop&y limb", copy_pose, document, vertex)
        menu.entry("Pas&te into limb", paste_pose, document, vertex)
        mesh = self._window.meshes.mesh_at(vertex)
        if mesh is not None:
            menu.entry(
                f"&Hide {menu_text(mesh)}",
                self._window.meshes.hide,
                mesh,
                tip="Neither drawn nor checked; View > Meshes shows it again",
                enabled=self._window.meshes.can_hide,
            )
        sizes = self._submenu(menu, "Patch si&ze")
        for text, radius in _RADII.items():
            sizes.entry(
                f"{text} ({100 * radius:g} %)",
                document.motion.set_grip_radius,
                radius,
                ticked=abs(radius - document.motion.grip_radius) < 1e-3,
            )
        sizes.addSeparator()
        sizes.addActions([self._actions[key] for key in ("smaller", "larger")])
        menu.addSeparator()

    def _fill(self, menu: ListMenu, domain: int | None, code: int | None) -> None:
        document, actions = self._document, self._actions
        if code is not None:
            row = self._sliders.row_of(code)
            is_moved = bool(document.history.latent[code] != 0.0)
            menu.entry("&Reset", document.motion.reset_code, code, enabled=is_moved)
            menu.entry("&Type a value…", row.edit_number)
            shapes = document.model.shape_codes
            if code >= shapes.start:
                is_shaped = bool(document.history.latent[shapes].any())
                menu.entry("Reset all &shapes", document.motion.reset_shapes, enabled=is_shaped)
            menu.addSeparator()
        if domain is not None:
            name = menu_text(heading(document.model.domain_names[domain]))
            locked = domain in document.motion.locked_domains
            set_locked, reset = document.motion.set_locked, document.motion.reset_domain
            menu.entry(f"&Lock {name}", set_locked, domain, not locked, ticked=locked)
            menu.entry(f"R&eset {name}", reset, domain, enabled=not locked)
            self._add_mirror(menu, domain)
            if code is None:
                menu.entry("&Show in sliders", self._sliders.show_domain, domain)
            menu.addSeparator()
            for text, what in ((f"Re&name {name}…", "name"), (f"&Colour of {name}…", "colour")):
                is_on = actions["parts"].isEnabled()
                menu.entry(text, edit_parts, self._window, domain, what, enabled=is_on)
        self._add_roles(menu, domain, code)
        menu.addAction(actions["parts"])
        menu.addSeparator()
        menu.addActions([actions["unlock"], actions["mirror"]])

    def _add_roles(self, menu: ListMenu, domain: int | None, code: int | None) -> None:
        """Add the roles of a character's joint: the slider's, or the only one of a body part."""
        from lcollision_core.bodies.anatomy import ROLE_NAMES, role_name

        model = self._document.model
        space = model.joints
        if space is None:
            return
        codes = model.latent_space.groups[0 if domain is None else 1 + domain].codes
        joint_codes = slice(code, code + 1) if code is not None else codes
        joints = {joint for joint in space.joint_of_code[joint_codes].tolist() if joint >= 0}
        if domain is None or len(joints) != 1:
            return
        joint = joints.pop()
        name = space.rig.joint_names[joint]
        now = role_name(space.roles[joint], space.sides[joint])
        roles = self._submenu(menu, f"Joint &role of {menu_text(name)}")
        is_chosen, set_role = name in space.rig.chosen, self._window.files.set_joint_role
        roles.entry("From the rig", set_role, name, None, enabled=is_chosen)
        roles.addSeparator()
        for role in ROLE_NAMES:
            words, _, side = role.partition("-")
            text = f"{side} {words}".strip().capitalize()
            roles.entry(text, set_role, name, role, ticked=role == now)

    def _add_mirror(self, menu: ListMenu, domain: int) -> None:
        """Add the entry to mirror a body part, if it has a counterpart on the other side."""
        document = self._document
        other = (
            None if document.model.why_not_mirrored else document.model.pose_mirror.partner(domain)
        )
        if other is not None:
            name = menu_text(document.model.domain_names[other])
            is_free = other not in document.motion.locked_domains
            menu.entry(f"M&irror to {name}", document.tasks.mirror_part, domain, enabled=is_free)

    def _submenu(self, menu: ListMenu, title: str) -> ListMenu:
        below = ListMenu(title, menu, self._window.attempt)
        menu.addMenu(below)
        return below

    def _new_menu(self) -> ListMenu:
        menu = ListMenu("", self._window, self._window.attempt)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        return menu
