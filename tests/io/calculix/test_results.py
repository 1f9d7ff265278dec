"""Printed results of CalculiX are read exactly, and incomplete ones are refused."""

import numpy as np
import pytest

from snrmjax.io.calculix.jobs import eigenvalues, first_error, last_energy, printed_tables

FREQUENCIES = """
     E I G E N V A L U E   O U T P U T

 MODE NO    EIGENVALUE                       FREQUENCY
                                     REAL PART            IMAGINARY PART
                           (RAD/TIME)      (CYCLES/TIME     (RAD/TIME)

      1  -0.1000000E-03   0.0000000E+00   0.0000000E+00   0.1000000E-01
      2   0.2531401E+06   0.5031303E+03   0.8007567E+02   0.0000000E+00

     P A R T I C I P A T I O N   F A C T O R S

      1   0.1096338E-13   0.1252982E-08  -0.1111023E+00   0.1355186E-12
"""
STATIC = """
 displacements (vx,vy,vz) for set N and time  0.2500000E+00

         3  1.000000E+00  2.000000E+00  3.000000E+00
         8  4.000000E+00  5.000000E+00  6.000000E+00

 total internal energy for set E and time  0.2500000E+00

        1.000000E-02

 displacements (vx,vy,vz) for set N and time  0.1000000E+01

         8  4.500000E+00  5.500000E+00 -6.500000E-01
         3  1.500000E-02  2.500000-101  3.500000E+00

 total internal energy for set E and time  0.1000000E+01

        5.482746E-06
"""
NODES = np.array([3, 8])


def test_eigenvalues_end_where_their_table_ends():
    np.testing.assert_array_equal(eigenvalues(FREQUENCIES), [-1e-4, 0.2531401e6])
    assert len(eigenvalues(STATIC)) == 0


def test_the_last_table_is_in_the_order_of_the_nodes():
    first, last = printed_tables(STATIC, NODES)
    assert (first.quantity, first.time, last.time) == ("displacements", 0.25, 1.0)
    np.testing.assert_array_equal(last.values, [[0.015, 2.5e-101, 3.5], [4.5, 5.5, -0.65]])


def test_the_energy_at_the_end():
    assert last_energy(STATIC) == 5.482746e-06
    assert last_energy(FREQUENCIES) is None


def test_a_print_that_is_cut_off():
    cut = STATIC[: STATIC.index("         3  1.500000E-02")]
    with pytest.raises(ValueError, match="displacements has 1 rows for 2 nodes: it is incomplete"):
        list(printed_tables(cut, NODES))


def test_the_first_error_on_one_line():
    log = "STEP 1\n\n *ERROR in calinput: at least\n        one fatal error\n\n *ERROR two\n"
    assert first_error(log) == "*ERROR in calinput: at least one fatal error"
    assert first_error("all is well") == ""
