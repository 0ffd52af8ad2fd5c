// Records of the black box. A part of core.cpp.

// Where a process is, as the end of the header says: the last four of BlackBox's.
void say_where(char *start, size_t committed, long long step, int phase, uint32_t agent) {
    const uint64_t until = committed;
    const int64_t number = step;
    const int32_t what = phase;
    memcpy(start + 32, &until, 8);
    memcpy(start + 40, &number, 8);
    memcpy(start + 48, &what, 4);
    memcpy(start + 52, &agent, 4);
}

// A record of bytes, padded; returns where it ends.
size_t put_record(char *start, size_t offset, long tag, long agent, const void *data, size_t length) {
    char *place = start + offset;
    const size_t padding = -length & 7;
    const unsigned char head[2] = {static_cast<unsigned char>(tag), 0};
    const uint16_t whose = static_cast<uint16_t>(agent);
    const uint32_t size = static_cast<uint32_t>(length);
    memcpy(place, head, 2);
    memcpy(place + 2, &whose, 2);
    memcpy(place + 4, &size, 4);
    memcpy(place + 8, data, length);
    memset(place + 8 + length, 0, padding);
    return offset + 8 + length + padding;
}

// A record of a step but for the rewards, for which room is left; returns where these go.
char *put_step(char *place, long tag, long long step, double time_s, size_t agents, const std::vector<double> &values) {
    const auto put = [&](const void *value, size_t size) {
        memcpy(place, value, size);
        place += size;
    };
    const unsigned char head[4] = {static_cast<unsigned char>(tag), 0, 0, 0};
    const uint32_t length = static_cast<uint32_t>(8 * (2 + agents + values.size()));
    const int64_t number = step;
    put(head, 4);
    put(&length, 4);
    put(&number, 8);
    put(&time_s, 8);
    std::copy_n(reinterpret_cast<const char *>(values.data()), 8 * values.size(), place + 8 * agents);
    return place;
}

// write_array(buffer, offset, tag, agent, array, step, phase) -> end | None
// A record of an array as BlackBox._raw packs it.
PyObject *write_array(PyObject *, PyObject *const *given, Py_ssize_t count) {
    if (count != 7) {
        return PyErr_Format(PyExc_TypeError, "write_array takes a buffer, an array and five numbers");
    }
    const Py_ssize_t offset = PyLong_AsSsize_t(given[1]);
    const long tag = PyLong_AsLong(given[2]), agent = PyLong_AsLong(given[3]), phase = PyLong_AsLong(given[6]);
    const long long step = PyLong_AsLongLong(given[5]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    Py_buffer array, buffer;
    if (PyObject_GetBuffer(given[4], &array, PyBUF_C_CONTIGUOUS) < 0) {
        PyErr_Clear(); // such as one that is not in order
        Py_RETURN_NONE;
    }
    if (PyObject_GetBuffer(given[0], &buffer, PyBUF_WRITABLE) < 0) {
        PyBuffer_Release(&array);
        return nullptr;
    }
    const size_t length = static_cast<size_t>(array.len), padding = -length & 7;
    const bool fits = offset >= 64 && buffer.len >= offset &&
                      length + padding + 8 <= static_cast<size_t>(buffer.len - offset) && length <= UINT32_MAX &&
                      tag >= 0 && tag <= 255 && agent >= 0 && agent <= 65535;
    if (fits) {
        char *start = static_cast<char *>(buffer.buf);
        const size_t end = put_record(start, static_cast<size_t>(offset), tag, agent, array.buf, length);
        say_where(start, end, step, static_cast<int>(phase), static_cast<uint32_t>(agent));
    }
    PyBuffer_Release(&array);
    PyBuffer_Release(&buffer);
    if (!fits) {
        return PyErr_Format(PyExc_ValueError, "an array is written beyond the end");
    }
    return PyLong_FromSize_t(static_cast<size_t>(offset) + 8 + length + padding);
}

// changes_of(earlier, now) -> bytes
// Which words differ, as numpy.packbits writes bits, and then the words of the second that do.
PyObject *changes_of(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Py_buffer before, now;
    if (count != 2) {
        return PyErr_Format(PyExc_TypeError, "changes_of takes two arrays");
    }
    if (PyObject_GetBuffer(given[0], &before, PyBUF_SIMPLE) < 0) {
        return nullptr;
    }
    if (PyObject_GetBuffer(given[1], &now, PyBUF_SIMPLE) < 0) {
        PyBuffer_Release(&before);
        return nullptr;
    }
    const size_t words = static_cast<size_t>(now.len) / 8, bytes = (words + 7) / 8;
    PyObject *found = nullptr;
    if (before.len != now.len || now.len % 8) {
        PyErr_SetString(PyExc_ValueError, "the arrays have different lengths, or no whole words");
    } else {
        std::vector<char> out(bytes + 8 * words, 0);
        const char *was = static_cast<const char *>(before.buf), *is = static_cast<const char *>(now.buf);
        char *end = out.data() + bytes;
        for (size_t group = 0; group < bytes; ++group) {
            const size_t first = 8 * group, last = std::min(first + 8, words);
            if (!memcmp(was + 8 * first, is + 8 * first, 8 * (last - first))) {
                continue;
            }
            unsigned mask = 0;
            for (size_t word = first; word < last; ++word) {
                if (memcmp(was + 8 * word, is + 8 * word, 8)) {
                    mask |= 128u >> (word - first);
                    memcpy(end, is + 8 * word, 8);
                    end += 8;
                }
            }
            out[group] = static_cast<char>(mask);
        }
        found = PyBytes_FromStringAndSize(out.data(), end - out.data());
    }
    PyBuffer_Release(&before);
    PyBuffer_Release(&now);
    return found;
}

// write_step(buffer, offset, tag, step, time_s, rewards, columns, phase) -> end | None
// A record of a step as BlackBox.step packs it, little-endian as every machine is for which this is built.
PyObject *write_step(PyObject *, PyObject *const *given, Py_ssize_t count) {
    Columns *columns = count == 8 ? columns_of(given[6]) : nullptr;
    if (!columns) {
        return PyErr_Format(PyExc_TypeError, "write_step takes a buffer, six more and columns");
    }
    const Py_ssize_t offset = PyLong_AsSsize_t(given[1]);
    const long tag = PyLong_AsLong(given[2]);
    const long long step = PyLong_AsLongLong(given[3]);
    const double time_s = PyFloat_AsDouble(given[4]);
    const long phase = PyLong_AsLong(given[7]);
    if (PyErr_Occurred()) {
        return nullptr;
    }
    PyObject *rewards = given[5];
    const std::vector<double> &values = *columns->values;
    if (!PyTuple_CheckExact(rewards) || tag < 0 || tag > 255) {
        Py_RETURN_NONE;
    }
    const size_t agents = static_cast<size_t>(PyTuple_GET_SIZE(rewards));
    const size_t payload = 8 * (2 + agents + values.size());
    Py_buffer buffer;
    if (PyObject_GetBuffer(given[0], &buffer, PyBUF_WRITABLE) < 0) {
        return nullptr;
    }
    if (offset < 64 || static_cast<size_t>(offset) + 8 + payload > static_cast<size_t>(buffer.len)) {
        PyBuffer_Release(&buffer);
        return PyErr_Format(PyExc_ValueError, "a step is written beyond the end");
    }
    char *place = put_step(static_cast<char *>(buffer.buf) + offset, tag, step, time_s, agents, values);
    for (size_t agent = 0; agent < agents; agent++) {
        const double reward = PyFloat_AsDouble(PyTuple_GET_ITEM(rewards, static_cast<Py_ssize_t>(agent)));
        if (reward == -1.0 && PyErr_Occurred()) {
            PyBuffer_Release(&buffer);
            return nullptr;
        }
        memcpy(place + 8 * agent, &reward, 8);
    }
    say_where(static_cast<char *>(buffer.buf), static_cast<size_t>(offset) + 8 + payload, step,
              static_cast<int>(phase), 0);
    PyBuffer_Release(&buffer);
    return PyLong_FromSize_t(static_cast<size_t>(offset) + 8 + payload);
}
