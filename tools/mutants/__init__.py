"""Single changes of the package's sources, and the tests that notice them: ``make mutants``."""
