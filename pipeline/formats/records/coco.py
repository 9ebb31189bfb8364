"""Read COCO's JSON, annotations and detections, for all commands that take such files.

The result is checked and complete: each image, annotation and detection is a COCO entry with all its keys, including those of
other programs, with `segmentation` as compressed run lengths, and with `bbox`, `area` and `iscrowd`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pycocotools import mask as coco_mask
from pydantic import ConfigDict, Field

from pipeline.formats.files.plain_json import without_nan
from pipeline.formats.rasters.geotiff import most_pixels
from pipeline.formats.records.coco_masks import BEYOND_PX, FORMS, run_lengths
from scene.common.config import Config, parse
from scene.common.errors import InputError
from scene.common.regular_file import read_json

_REMEDY = "name the folder of a split, such as my_set/train, or of a run, or a COCO file"
Id = Annotated[int, Field(ge=0, lt=2**63)]
Entry = dict[str, Any]


class _Entry(Config):
    """An entry of COCO, which may have additional keys."""

    model_config = ConfigDict(extra="allow", strict=True)


class _Category(_Entry):
    """A category."""

    id: Id


class _NamedImage(_Entry):
    """An image, as detections list it."""

    id: Id
    file_name: str = Field(min_length=1)


class _Image(_NamedImage):
    """An image with its size, px."""

    width: int = Field(ge=1)
    height: int = Field(ge=1)


class _Annotation(_Entry):
    """An annotated block."""

    id: Id
    image_id: Id
    category_id: Id
    bbox: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    area: float | None = Field(None, ge=0)
    iscrowd: Literal[0, 1] = 0
    segmentation: Any = None


class _Detection(_Annotation):
    """A detection."""

    id: Id | None = None  # type: ignore[assignment]  # COCO's results have no id
    score: float = Field(ge=0, le=1)


EntryT = TypeVar("EntryT", bound=_Entry)


@dataclass(frozen=True)
class Coco:
    """Annotations of fallen rock (blocks) in images, read from a file in COCO's format and checked.

    images, annotations and categories are the file's lists of these names, in its order.
    """

    images: list[Entry]
    annotations: list[Entry]
    categories: list[Entry]

    def to_dict(self) -> dict[str, list[Entry]]:
        """Return the COCO data set as a dictionary of lists, as pycocotools takes it."""
        return {"images": self.images, "annotations": self.annotations, "categories": self.categories}


def read_coco(path: Path, *, masks: bool = True) -> Coco:
    """Read and check annotations of blocks in images, a JSON file in COCO's format.

    Parameters
    ----------
    path : The JSON file.
    masks : Whether each annotation must have a mask; otherwise it needs a mask or a box.

    Raises
    ------
    InputError
        Naming the annotation, for wrong types and numbers, ids that are repeated or refer to nothing, images of more than
        `most_pixels`, boxes and polygons outside their image, and run lengths that do not fit their image.
    """
    content = read_json(path, remedy=_REMEDY)
    if not isinstance(content, Mapping):
        raise _no_coco(path, "it is not a mapping")
    for name in ("images", "annotations", "categories"):
        if not isinstance(content.get(name), list):
            raise _no_coco(path, f"'{name}' is {'not a list' if name in content else 'missing'}")
    if not content["images"]:
        raise InputError(
            "the list 'images' is empty",
            where=str(path),
            remedy="give the annotations file of the maps or tiles that are read here",
        )
    images = [entry for entry, _ in _parsed(_Image, content["images"], "image", path)]
    for image in images:
        _check_pixels(image, path)
    _unique(images, "file_name", "image", path)
    categories = [entry for entry, _ in _parsed(_Category, content["categories"], "category", path)]
    reader = _Masks({image["id"]: image for image in images}, {each["id"] for each in categories}, masks)
    annotations = _parsed(_Annotation, content["annotations"], "annotation", path)
    return Coco(images, [reader.complete(entry, where) for entry, where in annotations], categories)


def read_detections(path: Path, truth: Coco, *, masks: bool = True) -> list[Entry]:
    """Read detections in COCO's format, to score them against the true annotations of the same images.

    A file with a list of images (`scarpsim detect`) is matched with the truth by file name; a list of detections alone
    (pycocotools) by image id. The returned detections have the image ids of the truth.

    Parameters
    ----------
    path : The JSON file.
    truth : The true annotations.
    masks : Whether each detection must have a mask.

    Raises
    ------
    InputError
        As `read_coco` does, and for scores outside 0 to 1, and images that the truth does not have.
    """
    content = read_json(path, remedy=_REMEDY)
    entries = content.get("annotations") if isinstance(content, Mapping) else content
    if not isinstance(entries, list):
        raise InputError(
            "the file is not a list of COCO detections", where=str(path), remedy="give a detections.json of scarpsim detect"
        )
    if any(isinstance(entry, Mapping) and "score" not in entry for entry in entries):
        raise InputError(
            "the file has annotations without a score",
            where=str(path),
            remedy="give a detections.json of scarpsim detect, not the true blocks",
        )
    ids = {image["id"]: image["id"] for image in truth.images}
    if isinstance(content, Mapping):
        known = {image["file_name"]: image["id"] for image in truth.images}
        listed = content.get("images")
        if not isinstance(listed, list):
            raise _no_coco(path, f"'images' is {'not a list' if 'images' in content else 'missing'}")
        named = [entry for entry, _ in _parsed(_NamedImage, listed, "image", path)]
        _unique(named, "file_name", "image", path)
        ids = {image["id"]: known[image["file_name"]] for image in named if image["file_name"] in known}
    found = list(_parsed(_Detection, entries, "detection", path))
    strange = {entry["image_id"] for entry, _ in found} - set(ids)
    if strange:
        raise InputError(
            f"the file has detections in {len(strange)} images that the truth does not have, such as id {min(strange)}",
            where=str(path),
            remedy="give the annotations of the maps that were searched",
        )
    reader = _Masks({image["id"]: image for image in truth.images}, {each["id"] for each in truth.categories}, masks)
    return [reader.complete({**entry, "image_id": ids[entry["image_id"]]}, where) for entry, where in found]


@dataclass(frozen=True)
class _Masks:
    """Completes entries. images: by id; categories: known ids; needed: whether an entry without a mask is wrong."""

    images: Mapping[int, Entry]
    categories: set[int]
    needed: bool

    def complete(self, entry: Entry, where: str) -> Entry:
        """Return the entry with its mask as run lengths, its box, and the area of the mask, px, or of the box without a mask."""
        image = self.images.get(entry["image_id"])
        if image is None:
            allowed = f"the id of one of the {len(self.images)} images"
            raise InputError(
                f"the annotation refers to image {entry['image_id']}, which does not exist",
                where=where,
                allowed=allowed,
                remedy="leave the annotation out, or correct its image_id",
            )
        if entry["category_id"] not in self.categories:
            allowed = ", ".join(map(str, sorted(self.categories)[:20])) or "none, as the list is empty"
            raise InputError(
                f"the annotation's category {entry['category_id']} is not listed",
                where=where,
                allowed=allowed,
                remedy="add the category to the list `categories`, or correct category_id",
            )
        height, width = image["height"], image["width"]
        box, segmentation = entry.get("bbox"), entry.get("segmentation")
        if box is not None:
            _check_box(box, height, width, where)
        if segmentation is None and box is not None and not self.needed:
            return {"iscrowd": 0, **entry, "area": box[2] * box[3]}
        if segmentation is None:
            allowed = FORMS if self.needed else f"a bbox, or a segmentation of {FORMS}"
            raise InputError(
                "the annotation has no mask",
                where=where,
                allowed=allowed,
                remedy="draw the mask of this annotation, or leave the annotation out",
            )
        mask = run_lengths(segmentation, height, width, where)
        box = coco_mask.toBbox(mask).tolist() if box is None else box
        return {"iscrowd": 0, **entry, "segmentation": mask, "bbox": box, "area": int(coco_mask.area(mask))}


def _no_coco(path: Path, problem: str) -> InputError:
    """Return the error for a file that is not COCO."""
    return InputError(
        f"the file is not a COCO annotation file ({problem})",
        where=str(path),
        allowed="lists of images, annotations and categories",
        remedy="export the annotations as COCO again",
    )


def _parsed(model: type[EntryT], entries: Sequence[Any], kind: str, path: Path) -> Iterable[tuple[Entry, str]]:
    """Yield each entry, with checked types and a unique id, and its name in messages.

    NaN and infinity in keys that are not COCO's become null, as they cannot be written.
    """
    seen: set[int] = set()
    for number, entry in enumerate(entries):
        own = entry.get("id") if isinstance(entry, Mapping) else None
        where = f"{path}: {kind} {own}" if isinstance(own, int) and own < 2**63 else f"{path}: {kind} {number} of the list"
        if not isinstance(entry, Mapping):
            raise InputError(
                f"the entry is of the type {type(entry).__name__}",
                where=where,
                allowed=f"a mapping with {', '.join(name for name, field in model.model_fields.items() if field.is_required())}",
                remedy="export the annotations as COCO again",
            )
        try:
            parse(model, entry, where)
        except InputError as error:
            raise InputError(
                f"in this entry, {error.what}",
                where=where,
                allowed=_allowed(model),
                remedy="correct this entry, or leave it out",
            ) from None
        if own in seen:
            raise InputError(
                "the id of the entry occurs twice",
                where=where,
                allowed="a unique id",
                remedy="give each entry of the list an id of its own",
            )
        if own is not None:
            seen.add(own)
        others = {key: without_nan(value) for key, value in entry.items() if key not in model.model_fields}
        yield {**entry, **others}, where


def _allowed(model: type[_Entry]) -> str:
    """Describe the allowed fields of an entry."""
    if issubclass(model, _Annotation):
        score = ", a score from 0 to 1" if issubclass(model, _Detection) else ""
        return f"whole numbers as ids, a bbox of 4 finite numbers{score}"
    if issubclass(model, _NamedImage):
        return "a whole number as id, a file_name, width and height in px"
    return "a whole number as id"


def _unique(entries: Sequence[Entry], key: str, kind: str, path: Path) -> None:
    """Raise InputError if a value of a key occurs twice."""
    seen: set[Any] = set()
    for entry in entries:
        if entry[key] in seen:
            raise InputError(
                f"the {key} '{entry[key]}' occurs twice",
                where=f"{path}: {kind} {entry['id']}",
                remedy="leave out one of the two entries",
            )
        seen.add(entry[key])


def _check_pixels(image: Entry, path: Path) -> None:
    """Raise InputError for an image that is too large."""
    height, width = image["height"], image["width"]
    if height * width > (most := most_pixels()):
        raise InputError(
            f"the image has {height} x {width} px",
            where=f"{path}: image {image['id']}",
            allowed=f"at most {most:,} px",
            remedy="cut the image into tiles",
        )


def _check_box(box: Sequence[float], height: int, width: int, where: str) -> None:
    """Raise InputError for a box outside its image."""
    x, y, across, down = box
    inside = min(x, y) >= -BEYOND_PX and x + across <= width + BEYOND_PX and y + down <= height + BEYOND_PX
    if min(across, down) < 0 or not inside:
        raise InputError(
            f"the annotation's bbox is {list(box)}",
            where=where,
            allowed=f"x, y, width, height inside the image of {width} x {height} px",
            remedy="write bbox as [x, y, width, height] in pixels: first the top-left corner, then the lengths",
        )
