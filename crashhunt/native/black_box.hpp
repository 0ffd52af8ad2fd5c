// Records of the black box. A part of core.cpp.

// Where a process is, as the end of the header says: the last four of BlackBox's.
void say_where(char *start, size_t committed, long long step, int phase) {
    const uint64_t until = committed;
    const int64_t number = step;
    const int32_t what = phase;
    const uint32_t agent = 0;
    memcpy(start + 32, &until, 8);
    memcpy(start + 40, &number, 8);
    memcpy(start + 48, &what, 4);
    memcpy(start + 52, &agent, 4);
}

// A record of the bytes of the only agent, padded; returns where it ends.
size_t put_record(char *start, size_t offset, long tag, const void *data, size_t length) {
    char *place = start + offset;
    const size_t padding = -length & 7;
    const unsigned char head[4] = {static_cast<unsigned char>(tag), 0, 0, 0};
    const uint32_t size = static_cast<uint32_t>(length);
    memcpy(place, head, 4);
    memcpy(place + 4, &size, 4);
    memcpy(place + 8, data, length);
    memset(place + 8 + length, 0, padding);
    return offset + 8 + length + padding;
}

// A record of a step of one agent; returns where it ends.
size_t put_step(char *start, size_t offset, long tag, long long step, double time_s, double reward,
                const std::vector<double> &values) {
    const int64_t number = step;
    std::vector<char> payload(24);
    memcpy(payload.data(), &number, 8);
    memcpy(payload.data() + 8, &time_s, 8);
    memcpy(payload.data() + 16, &reward, 8);
    const char *first = reinterpret_cast<const char *>(values.data());
    payload.insert(payload.end(), first, first + 8 * values.size());
    return put_record(start, offset, tag, payload.data(), payload.size());
}

// changes_of(earlier, now) -> bytes
// Which words differ, as numpy.packbits writes bits, and then the words of the second that do.
Ref changes_of(PyObject *earlier, PyObject *later) {
    const Buffer before(earlier, PyBUF_SIMPLE), now(later, PyBUF_SIMPLE);
    const size_t words = now.size() / 8, bytes = (words + 7) / 8;
    if (before.size() != now.size() || now.size() % 8) {
        raise(PyExc_ValueError, "the arrays have different lengths, or no whole words");
    }
    std::vector<char> out(bytes + 8 * words, 0);
    const char *was = before.bytes(), *is = now.bytes();
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
    return Ref(PyBytes_FromStringAndSize(out.data(), end - out.data()));
}
