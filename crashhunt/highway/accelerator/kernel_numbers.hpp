// Arithmetic with the bits of NumPy and Python. A part of kernel.cpp.

#pragma once

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace {

#include "../../native/python.hpp"

// The beginning of NumPy's `PyUFuncObject`, which is a part of NumPy's stable interface.
typedef void (*Loop)(char **, const Py_ssize_t *, const Py_ssize_t *, void *);
struct UFunc {
    PyObject_HEAD
    int nin, nout, nargs, identity;
    Loop *functions;
    void *const *data;
    int ntypes, reserved;
    const char *name;
    const char *types;
};
const char DOUBLE = 12; // NumPy's number of the type float64

struct NumpyFunction {
    Loop loop;
    void *data;
};
enum { SIN, COS, TAN, ARCSIN, ARCTAN, ARCTAN2, POWER, FUNCTIONS };
const char *const NAMES[FUNCTIONS] = {"sin", "cos", "tan", "arcsin", "arctan", "arctan2", "power"};

NumpyFunction functions[FUNCTIONS];
bool fused = false;           // whether NumPy's scalar product of two vectors uses fused multiply-adds
bool product_fused = false;   // whether NumPy's product of two matrices does
// How NumPy multiplies a matrix by a vector: UNKNOWN, rounding both products of a row, or only one of them.
enum { UNKNOWN, BOTH, ONLY_SECOND, ONLY_FIRST, TURNS };
int turn_rounds = UNKNOWN;
Py_ssize_t exponent_step = 0; // the stride with which NumPy passes the exponent of a power of two numbers

const double PI = 3.14159265358979323846;
const double TAU = 2 * PI;

double call(int number, double x) {
    double y;
    char *args[2] = {reinterpret_cast<char *>(&x), reinterpret_cast<char *>(&y)};
    const Py_ssize_t count = 1, steps[2] = {sizeof(double), sizeof(double)};
    functions[number].loop(args, &count, steps, functions[number].data);
    return y;
}

double call(int number, double x, double y) {
    double z;
    char *args[3] = {reinterpret_cast<char *>(&x), reinterpret_cast<char *>(&y), reinterpret_cast<char *>(&z)};
    const Py_ssize_t count = 1;
    const Py_ssize_t steps[3] = {sizeof(double), number == POWER ? exponent_step : Py_ssize_t(sizeof(double)),
                                 sizeof(double)};
    functions[number].loop(args, &count, steps, functions[number].data);
    return z;
}

// BLAS begins a sum of products with 0, and adds it to 0: a product that is too small for a float64 gives no negative zero.
double sum_of_products(bool is_fused, double ax, double ay, double bx, double by) {
    if (is_fused) {
        return std::fma(ay, by, std::fma(ax, bx, 0.0)) + 0.0;
    }
    return (0.0 + ax * bx) + ay * by;
}

// np.dot of two vectors of two numbers.
double dot(double ax, double ay, double bx, double by) { return sum_of_products(fused, ax, ay, bx, by); }

// An element of the product of two matrices: of a row with two numbers and a column with two numbers.
double product(double ax, double ay, double bx, double by) { return sum_of_products(product_fused, ax, ay, bx, by); }

// An element of the product of a matrix and a vector, of two numbers each.
double turned(double ax, double ay, double bx, double by) {
    double found = turn_rounds == ONLY_SECOND  ? std::fma(ax, bx, ay * by)
                   : turn_rounds == ONLY_FIRST ? std::fma(ay, by, ax * bx)
                                               : ax * bx + ay * by;
    return found + 0.0; // BLAS adds it to 0, which decides the sign of a zero result
}

// The same as `dot` for vectors of three numbers.
double dot(const double *a, const double *b) {
    double found = dot(a[0], a[1], b[0], b[1]);
    return fused ? std::fma(a[2], b[2], found) + 0.0 : found + a[2] * b[2];
}

// Python's `x ** 2`, which is the C library's power; a compiler would otherwise make it a product.
double square(double x) {
    volatile double exponent = 2;
    return std::pow(x, exponent);
}

// Python's and NumPy's remainder, which has the sign of the divisor.
double remainder_of(double a, double b) {
    double found = std::fmod(a, b);
    if (found != 0) {
        if ((b < 0) != (found < 0)) {
            found += b;
        }
        return found;
    }
    return std::copysign(0.0, b);
}

double wrap_to_pi(double x) { return remainder_of(x + PI, TAU) - PI; }

double not_zero(double x) { return std::fabs(x) > 1e-2 ? x : (x >= 0 ? 1e-2 : -1e-2); }

double clip(double x, double low, double high) {
    double found = x < low ? low : x;
    return found > high ? high : found;
}

} // namespace
