"""Run records, tables, figures and moving pictures: how results are written down."""
