"""Pictures: the scene from above, panels that an agent provides, and films of both.

Drawing needs Pillow, and MP4 needs PyAV: ``pip install 'crashhunt[video]'``. Panels themselves need neither, so an
agent can create panels that are not drawn.
"""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from crashhunt.panels import (
        Action as Action,
        ActionDistribution as ActionDistribution,
        Bar as Bar,
        Contour as Contour,
        Curve as Curve,
        Curve3D as Curve3D,
        Heatmap as Heatmap,
        Panel as Panel,
        Picture as Picture,
        Text as Text,
        labelled as labelled,
        scope as scope,
    )

    from ._film import (
        FilmOptions as FilmOptions,
        Layout as Layout,
        Shot as Shot,
        check_places as check_places,
        explanation as explanation,
        frames as frames,
        load_meanings as load_meanings,
        load_panels as load_panels,
        save_meanings as save_meanings,
        save_panels as save_panels,
        shown_steps as shown_steps,
        write_frames as write_frames,
        write_gif as write_gif,
        write_video as write_video,
    )
    from ._scene_from_above import SceneView as SceneView

offer_lazily(__name__)
