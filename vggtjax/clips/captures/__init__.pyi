from .capture import Capture as Capture
from .capture import CaptureKind as CaptureKind
from .table import capture_kind as capture_kind
from .table import find_capture as find_capture
from .table import read_capture as read_capture
