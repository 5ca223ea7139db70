"""A certificate as people read it."""

from cfplan.cli.output import print_table
from cfplan.safety.certificate import Certificate


def print_certificate(certificate: Certificate) -> None:
    """One row a limit: the worst value anywhere on the flight, its share of the limit, when."""
    verdict = "passed" if certificate.passed else "FAILED"
    columns = ["limit", "worst", "allowed", "share", "at", "where"]
    print_table(f"Certificate: {verdict}", columns, certificate.rows())
