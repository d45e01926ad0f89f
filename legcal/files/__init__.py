"""Reading and writing files safely: schemas, tables, paths, all or nothing."""
