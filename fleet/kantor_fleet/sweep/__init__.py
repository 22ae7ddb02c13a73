"""`kantor sweep`: many seeds, many variants, one table."""
