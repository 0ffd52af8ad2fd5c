from ._film import (
    FilmOptions as FilmOptions,
    Layout as Layout,
    Shot as Shot,
    check_places as check_places,
    frames as frames,
    shown_steps as shown_steps,
    write_frames as write_frames,
    write_gif as write_gif,
    write_video as write_video,
)
from ._panel_files import (
    explanation as explanation,
    load_meanings as load_meanings,
    load_panels as load_panels,
    save_meanings as save_meanings,
    save_panels as save_panels,
)
from ._panels import (
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
from ._scene import SceneView as SceneView
