"""Renders, captures and volumes on disk, read and written."""

from torchtransient.files.captures.formats import read_capture as read_capture
from torchtransient.files.captures.formats import write_capture as write_capture
from torchtransient.files.content_key import content_key as content_key
from torchtransient.files.result_file import Result as Result
from torchtransient.files.result_file import read_result as read_result
from torchtransient.files.result_file import write_result as write_result
from torchtransient.files.volume_file import read_volume as read_volume
from torchtransient.files.volume_file import write_volume as write_volume
