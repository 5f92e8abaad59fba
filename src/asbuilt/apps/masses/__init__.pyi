from .computed_masses import LinkMasses as LinkMasses
from .computed_masses import link_masses as link_masses
from .computed_masses import read_cad_table as read_cad_table
from .mass_findings import LinkMass as LinkMass
from .solids import link_from_meshes as link_from_meshes
from .tables import masses_document as masses_document
from .tables import masses_table as masses_table
from .tables import write_masses as write_masses
