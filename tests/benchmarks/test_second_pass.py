"""What the second pass costs and brings: the report by hand, errors of a pass, and draws that are joined."""

import numpy as np

from benchmarks.second_pass import Run, report_text


def test_the_report_by_hand():
    errors = {
        Run("moving", "none", 0): np.array([[4, 0.4], [2, 0.2]]),
        Run("frozen", "none", 0): np.array([[1, 0.1], [1, 0.1]]),
        Run("moving", "the movers'", 5): np.array([[3, 0.2], [1, 0.2]]),
        Run("moving", "another scene's", 5): np.array([[4, 0.4], [4, 0.4]]),
        Run("frozen", "the movers'", 5): np.array([[1.5, 0.1], [1.1, 0.1]]),
        Run("frozen", "another scene's", 5): np.array([[1.5, 0.2], [1.5, 0.2]]),
    }
    text = report_text(errors, "Two scenes.")
    assert text.startswith("Two scenes. Changes are")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    assert cells[4] == ["moving", "the movers'", "5", "2.00", "-1.00 ± 0.00", "0.2000", "-0.1000 ± 0.1000"]
    facts = {(row[0], row[1], row[2].split(" ")[0]): row[3:] for row in cells if len(row) == 5}
    assert facts["moving", "-", "cost"] == ["+2.00 ± 1.00", "+0.2000 ± 0.1000"]
    assert facts["moving", "-", "the"] == ["+66.7 ± 11.1 %", "+66.7 ± 11.1 %"]
    # the changes are -1, -1 of 3, 1, and -0.2, 0 of 0.3, 0.1: residuals -1/2, 1/2 and -0.05, 0.05
    assert facts["moving", "5", "change"] == ["-50.0 ± 25.0 %", "-50.0 ± 25.0 %"]
    assert facts["moving", "5", "another"] == ["+2.00 ± 1.00", "+0.2000 ± 0.0000"]
    assert facts["frozen", "5", "change"] == ["+30.0 ± 20.0 %", "+0.0 ± 0.0 %"]
    assert facts["frozen", "5", "another"] == ["+0.20 ± 0.20", "+0.1000 ± 0.0000"]
