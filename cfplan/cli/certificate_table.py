"""The certificate as a table for people."""

from cfplan.cli.output import print_table
from cfplan.safety.certificate import Certificate


def print_certificate(certificate: Certificate) -> None:
    """Print one row per limit: the worst value on the flight, its usage of the limit, when and where."""
    verdict = "passed" if certificate.passed else "FAILED"
    columns = ["limit", "worst", "allowed", "share", "at", "where, m"]
    print_table(f"Certificate: {verdict}", columns, certificate.rows())
