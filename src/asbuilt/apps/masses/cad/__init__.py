"""Mass properties of links from CAD: meshes with materials, tables that CAD programs export."""
