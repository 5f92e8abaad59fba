from .format import program_format as program_format
from .program_writers import make_program as make_program
from .program_writers import program_document as program_document
from .program_writers import program_request as program_request
from .program_writers import program_text as program_text
from .program_writers import write_program as write_program
