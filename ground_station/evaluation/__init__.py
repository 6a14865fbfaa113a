"""How good an estimate is: trajectory errors, tables, plots, reports."""
