"""The paper's experiments: trials, claims with verdicts, tables and figures."""
