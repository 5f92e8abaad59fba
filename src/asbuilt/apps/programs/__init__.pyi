from .controller_program import make_program as make_program
from .controller_program import program_document as program_document
from .controller_program import program_request as program_request
from .controller_program import program_text as program_text
from .controller_program import write_program as write_program
from .format import program_format as program_format
