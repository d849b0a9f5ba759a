"""Decoding of the observation fields of RINEX lines, and writing of fields into arrays."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Bytes, Floats, Indices, Integers, Masks
from railfix.kernels.compiling import inner, kernel

_U = np.uint64
#: Copies of constants in `railfix.io.rinex.observations_decode`.
_WIDTH, _TAIL_WRONG, _BLANK, _ZERO = 16, np.uint8(255), np.uint8(32), np.uint8(48)
_BLANKS, _ZEROS, _ZEROS_POINT = _U(0x2020202020202020), _U(0x3030303030303030), _U(0x30303030302E3030)
_NOT_A_DIGIT, _MINUS, _BYTE, _ONE, _NONE = _U(0x1010101010101010), _U(0x0D0D0D0D0D0D0D0D), _U(0xFF), _U(1), _U(0)
_LOW_2, _LOW_6, _DECIMALS = _U(0xFFFF), _U(0xFFFFFFFFFFFF), _U(0xFFFFFF000000)
_OVER_NINE, _OVER_NINE_6 = _U(0x0606060606060606), _U(0x060606060606)
_HIGH_NIBBLES, _POINT, _PAIRS = _U(0xF0F0F0F0F0F0F0F0), _U(0xFF0000), _U(0x000000FF000000FF)
_4, _8, _10, _16, _24, _32 = _U(4), _U(8), _U(10), _U(16), _U(24), _U(32)
_LINE_FEEDS, _EACH_1, _EACH_128 = _U(0x0A0A0A0A0A0A0A0A), _U(0x0101010101010101), _U(0x8080808080808080)
_LOW_PAIR, _HIGH_PAIR = _U(100 + (1_000_000 << 32)), _U(1 + (10_000 << 32))


@inner
def _eight_digits(word: np.uint64) -> np.uint64:
    """Return the value of eight decimal digits, with the most significant digit in the lowest byte."""
    word = word * _10 + (word >> _8)
    return ((word & _PAIRS) * _LOW_PAIR + ((word >> _16) & _PAIRS) * _HIGH_PAIR) >> _32


@inner
def _word(data: Bytes, at: np.uintp) -> np.uint64:
    """Return eight characters as an integer, the first in the lowest byte, by a single load instruction."""
    word = _U(data[at])
    for i in range(1, 8):
        word |= _U(data[at + np.uintp(i)]) << _U(8 * i)
    return word


@kernel
def decode_fields(
    data: Bytes, start: Integers, length: Integers, index: Indices, divisor: Floats
) -> tuple[Floats, Bytes, Masks]:
    """Decode the fields of n lines that have the standard form; the arguments are those of `read_fields`.

    All results have shape (n, k). Return the values, which are NaN for blank fields and fields of another form. Also
    return the loss-of-lock digits (255 if the last two characters are invalid), and a mask of fields of another form.
    """
    rows, columns = len(start), len(index)
    value, lock = np.empty((rows, columns)), np.zeros((rows, columns), dtype=np.uint8)
    odd = np.zeros((rows, columns), dtype=np.bool_)
    for r in range(rows):
        for j in range(columns):
            at, left = start[r] + _WIDTH * index[j], length[r] - _WIDTH * index[j]
            value[r, j] = math.nan
            if left <= 0:
                continue
            first, second = _word(data, np.uintp(at)), _word(data, np.uintp(at + 8))
            if left < _WIDTH:  # the rest of the line is blank
                cut = _U(8 * (left % 8))
                if left < 8:
                    first, second = _BLANKS ^ ((first ^ _BLANKS) & ((_ONE << cut) - _ONE)), _BLANKS
                else:
                    second = _BLANKS ^ ((second ^ _BLANKS) & ((_ONE << cut) - _ONE))
            digit, strength = np.uint8((second >> _U(48)) & _BYTE), np.uint8(second >> _U(56))
            if digit != _BLANK:
                lock[r, j] = digit - _ZERO
            wrong_digit = digit != _BLANK and np.uint8(digit - _ZERO) > 9
            if wrong_digit or (strength != _BLANK and np.uint8(strength - _ZERO) > 9):
                lock[r, j], odd[r, j] = _TAIL_WRONG, True
                continue
            if first == _BLANKS and (second ^ _BLANKS) & _LOW_6 == _NONE:
                continue
            high, low = first ^ _ZEROS, second ^ _ZEROS_POINT
            lead_high = ((high & _NOT_A_DIGIT) >> _4) * _BYTE
            lead_low = ((low & _NOT_A_DIGIT & _LOW_2) >> _4) * _BYTE
            sign_high, sign_low = (high ^ _NOT_A_DIGIT) & lead_high, (low ^ _NOT_A_DIGIT) & lead_low
            digits, decimals = high & ~lead_high, low & ~lead_low & _LOW_6
            wrong = ((digits + _OVER_NINE) | (decimals + _OVER_NINE_6)) & _HIGH_NIBBLES
            wrong |= (low & _POINT) | (lead_high & (lead_high + _ONE)) | (lead_low & (lead_low + _ONE))
            if sign_high != _NONE:
                wrong |= sign_high ^ ((lead_high ^ (lead_high >> _8)) & _MINUS)
            if sign_low != _NONE:
                wrong |= sign_low ^ ((lead_low ^ (lead_low >> _8)) & _MINUS)
            if wrong != _NONE or (lead_low != _NONE and first != _BLANKS):
                odd[r, j] = True
                continue
            part = ((decimals & _LOW_2) << _24) | ((decimals & _DECIMALS) << _16)
            number = float(_eight_digits(digits)) * 100_000.0 + float(_eight_digits(part))
            value[r, j] = (number if (sign_high | sign_low) == _NONE else -number) / (1000.0 * divisor[j])
    return value, lock, odd


@kernel
def place_fields(
    kinds: Floats, lock: Bytes, cell: Integers, kind: Indices, signal: Indices, value: Floats, digit: Bytes
) -> tuple[Floats, Bytes]:
    """Write fields into dense arrays in place, and return these arrays. Fields with the value 0 are not written.

    Parameters
    ----------
    kinds, lock : ndarray, shape (4, T, M), and of uint8, (T, M)
        Values per kind of observable, and loss-of-lock digits.
    cell : ndarray of int, shape (n,)
        For each line, M times the index of the epoch plus the index of the satellite's first channel.
    kind, signal : ndarray of int, shape (k,)
        Kind of observable of each field, and index of its channel within the satellite.
    value, digit : ndarray, shape (n, k)
        Results of `decode_fields`.
    """
    flat, flat_lock = kinds.reshape(len(kinds), -1), lock.reshape(-1)
    for r in range(len(cell)):
        for j in range(len(kind)):
            at = cell[r] + signal[j]
            if value[r, j] != 0.0:
                flat[kind[j], at] = value[r, j]
            if kind[j] == 1:
                flat_lock[at] = digit[r, j]
    return kinds, lock


@kernel
def line_ends(data: Bytes) -> Integers:
    """Return the positions of the line feeds in a text."""
    ends, found = np.empty(1024, dtype=np.int64), 0
    for at in range(0, len(data), 8):
        if at + 8 <= len(data):
            other = _word(data, np.uintp(at)) ^ _LINE_FEEDS
            if (other - _EACH_1) & ~other & _EACH_128 == _NONE:
                continue
        if found + 8 > len(ends):
            more = np.empty(2 * len(ends), dtype=np.int64)
            for i in range(found):
                more[i] = ends[i]
            ends = more
        for i in range(at, min(at + 8, len(data))):
            if data[i] == 10:
                ends[found] = i
                found += 1
    return ends[:found].copy()
