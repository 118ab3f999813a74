"""``vislam verify``: does an estimator keep what every estimator promises?"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from toolkit.cli.arguments import epilog

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "verify",
        help="check that an estimator of your own keeps what every estimator promises",
        description="Run an estimator on simulated recordings and check what every estimator promises: it is causal "
        "and deterministic, on any number of threads; it changes nothing it was given; its numbers are finite, its "
        "covariances sound and honest; it survives every planted fault. What failed is named, with what to do.",
        epilog=epilog("vislam verify dead-reckoning"),
    )
    parser.add_argument(
        "estimator", metavar="FILE.py|NAME", help="a file or a module with build(setup), or an installed estimator"
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--json", action="store_true", help="print the result as JSON")
    what.add_argument("--quiet", action="store_true", help="print nothing; the exit status tells")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Verify, print and return 1 where a promise is broken."""
    from toolkit.documents import to_text
    from toolkit.progress import of_this_process
    from toolkit.report.prose import width_of_output
    from toolkit.report.verify_text import verification_document, verification_text
    from toolkit.verify.subject import subject_of
    from toolkit.verify.verification import verify

    subject = subject_of(options.estimator)
    with of_this_process()(f"{subject.name}: promises") as progress:
        found = verify(subject, options.estimator, progress)
    if options.json:
        print(to_text(verification_document(found)), end="")
    elif not options.quiet:
        print(verification_text(found, width_of_output()))
    return 0 if found.passed else 1
