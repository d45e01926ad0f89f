from .importing import Import as Import
from .importing import import_recordings as import_recordings
from .importing import plan_import as plan_import
from .stillness import Still as Still

__all__: list[str]
