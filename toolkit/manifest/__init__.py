"""The manifest (what to run) and the tree of settings that all stages share."""

from toolkit.manifest.loading import find_manifest, load_manifest
from toolkit.manifest.manifest import OPTIONAL, STAGES, DatasetSettings, DemoData, Manifest, Source
from toolkit.manifest.settings import (
    AUTO,
    AlikedModel,
    AlikedSettings,
    Checkpoint,
    EmbedSettings,
    EvaluateSettings,
    ExploreSettings,
    FeaturesSettings,
    LocalizeSettings,
    MapSettings,
    MaskSettings,
    MatcherSettings,
    PnpSettings,
    PredictorSettings,
    RerankSettings,
    RetrieveSettings,
    SequenceSettings,
    Settings,
    SiftSettings,
    SuperPointSettings,
    VisualizeSettings,
    checkpoint_of,
    describe,
    nearest,
)
